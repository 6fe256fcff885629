"""The messages of one source as Foxglove's: for a file, or live.

docs/reference/takes.md has the table of topics.
"""

from collections.abc import Container, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from foxglove.messages import (
    FrameTransform,
    FrameTransforms,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    PointCloud,
    Quaternion,
    SceneUpdate,
    Vector3,
)

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import json_text
from gateway.messages.descriptions.labels import (
    EVENT_VALUES,
    describe,
    event_labels,
    event_text,
    event_time_us,
)
from gateway.messages.encode import metres_per_unit
from gateway.messages.foxglove.plates import NO_POSE, PlateScene
from gateway.messages.foxglove.topics import (
    MAX_FIELDS,
    MAX_UTIME,
    FloatRecord,
    FloatTopics,
    FoxgloveMessage,
    FoxgloveTopic,
    TopicMessages,
    field_names,
    json_topic,
    timestamp,
    topic_of,
)
from gateway.rtc3d.components import WIRE_ORDER, ComponentType, Items, num_described_items
from gateway.rtc3d.parameters import Parameters

_POINT: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("reliability", "<f4"), ("marker", "<u4")]
)
_POINT_FIELDS: Final = [
    PackedElementField(
        name=name,
        offset=4 * index,
        type=(
            PackedElementFieldNumericType.Uint32
            if name == "marker"
            else PackedElementFieldNumericType.Float32
        ),
    )
    for index, name in enumerate(_POINT.names or ())
]
_LOADS: Final = ("fx", "fy", "fz", "mx", "my", "mz")
FIELD_NOUNS: Final = {ComponentType.ANALOG: "channel", ComponentType.FORCE: "plate"}
"""What channels and plates without a name are called."""

NUMBERS_PER_ITEM: Final = {ComponentType.ANALOG: 1, ComponentType.FORCE: len(_LOADS)}
"""The components whose messages have a field for each number."""

_MAX_LAYOUTS: Final = 100
"""How many different numbers of items of one component are remembered."""

_MAX_EVENTS: Final = 100
"""How many messages of events are remembered: the same button is pressed again and again."""

_MILLIMETRE: Final = 1e-3


@dataclass(frozen=True, slots=True)
class FixedTopics:
    """The topics of a source whose schemas do not depend on its labels; FloatTopics has the others."""

    markers: FoxgloveTopic
    tools: FoxgloveTopic
    events: FoxgloveTopic
    outlines: FoxgloveTopic
    """The outlines of force plates."""

    arrows: FoxgloveTopic
    """The forces on the plates."""

    description: FoxgloveTopic
    """The labels, units and rates."""


class FoxgloveSource:
    """Converts messages of one source, as long as its parameters are the same.

    When they change, create another one with the same ``topics``. ``version`` is that of the parameters.
    Positions are in ``frame``, whose unit must be known where positions are converted. None means the
    server's axes, in metres; an unknown unit counts as mm then, and ``problem`` says so in a sentence.
    """

    def __init__(
        self,
        topics: FloatTopics,
        parameters: Parameters,
        version: int,
        frame: CoordinateFrame | None = None,
    ) -> None:
        self.source = source = topics.source
        self.problem = ""
        self._topics = topics
        self._parameters = parameters
        self._version = version
        self._facts = {} if frame is None else {"frame": frame.facts}
        if frame is None:
            unit = parameters.length_unit
            metres = metres_per_unit(unit)
            if metres is None:
                self.problem = f"the unit of length {unit!r} is unknown; positions are shown as if it were mm"
            frame = CoordinateFrame(source, metres or _MILLIMETRE)
        self._frame = frame
        self._plates = PlateScene(parameters, frame)
        self._labels_of = lru_cache(_MAX_LAYOUTS)(self._find_labels)
        self._event_message = lru_cache(_MAX_EVENTS)(self._find_event_message)
        self._number_records = lru_cache(_MAX_LAYOUTS)(self._new_records)
        self._fixed = FixedTopics(
            markers=topic_of(f"/{source}/markers", PointCloud),
            tools=topic_of(f"/{source}/tools", FrameTransforms),
            events=topic_of(f"/{source}/events", Log),
            outlines=topic_of(f"/{source}/plates", SceneUpdate),
            arrows=topic_of(f"/{source}/forces", SceneUpdate),
            description=json_topic(f"/{source}/parameters", "rtc3d.Parameters", {"type": "object"}),
        )

    @property
    def known_topics(self) -> dict[FoxgloveTopic, ComponentType | None]:
        """All topics and their components; those of numbers only if the parameters say how many there are."""
        return dict.fromkeys((self._fixed.description, self._fixed.outlines)) | {
            topic: component
            for component in WIRE_ORDER
            for topic in self.topics(component, num_described_items(self._parameters, component))
        }

    @property
    def changed_names(self) -> dict[str, dict[str, str]]:
        """The names of fields that are not the labels of channels or plates, by component key and label."""
        found: dict[str, dict[str, str]] = {}
        for component, noun in FIELD_NOUNS.items():
            labels = self._labels_of(component, num_described_items(self._parameters, component))
            names = zip(labels, field_names(labels, noun), strict=True)
            found[component.key] = {label: name for label, name in names if label != name}
        return {key: names for key, names in found.items() if names}

    def topics(self, component: ComponentType, num_items: int) -> tuple[FoxgloveTopic, ...]:
        """Return the topics that a component with this many items has."""
        match component:
            case ComponentType.MARKERS:
                return (self._fixed.markers,)
            case ComponentType.TOOLS:
                return (self._fixed.tools,)
            case ComponentType.ANALOG:
                return tuple(self._number_records(component, num_items))
            case ComponentType.FORCE:
                return (*self._number_records(component, num_items), self._fixed.arrows)
            case ComponentType.EVENT:
                return (self._fixed.events,)

    def describe(self, utime: int) -> list[FoxgloveMessage]:
        """Return what is the same for all messages: labels, units and rates, and the outlines of plates."""
        content: dict[str, Any] = {"version": self._version, **self._facts}
        for component in WIRE_ORDER:
            if num_items := num_described_items(self._parameters, component):
                found = describe(component, self._parameters, num_items)
                content[component.key] = {
                    "labels": found.labels,
                    "units": found.units,
                    "moment_unit": found.moment_unit,
                    "rate_hz": found.rate_hz,
                }
                if component is ComponentType.ANALOG:
                    content[component.key]["fields"] = field_names(found.labels, "channel")
        labels = {str(number): label for number, label in event_labels(self._parameters).items()}
        content["event"] = {"labels": labels}
        data = json_text(content).encode()
        return [
            FoxgloveMessage(self._fixed.description, utime, data),
            FoxgloveMessage(self._fixed.outlines, utime, self._plates.outlines(utime)),
        ]

    def convert_frames(
        self,
        component: ComponentType,
        items: Items,
        capture_utimes: list[int],
        timestamps_us: list[int],
        arrow_interval: int = 1,
        wanted: Container[FoxgloveTopic] | None = None,
    ) -> Iterator[TopicMessages]:
        """Yield the messages of one component of many frames, on the ``wanted`` topics; None means all.

        ``items`` has the shape (frames, items) and the dtype of ITEM_DTYPES in any byte order.
        ``capture_utimes`` are in µs since 1970, from 0 to MAX_UTIME, and ``timestamps_us`` the server's time
        stamps. Forces are drawn in one of ``arrow_interval`` frames only.
        """
        num_frames, num_items = items.shape
        frames = range(num_frames)
        records = self._number_records(component, num_items) if component in NUMBERS_PER_ITEM else {}
        for topic in self.topics(component, num_items):
            if wanted is not None and topic not in wanted:
                continue
            record = records.get(topic)
            if record is not None:
                yield TopicMessages(topic, capture_utimes, record.encode_rows(_floats(items)), frames)
            elif topic is self._fixed.markers:
                yield TopicMessages(topic, capture_utimes, self._clouds(items, capture_utimes), frames)
            elif topic is self._fixed.tools:
                yield self._transforms(items, capture_utimes)
            elif topic is self._fixed.arrows:
                drawn = slice(None, None, arrow_interval)
                utimes = capture_utimes[drawn]
                yield TopicMessages(topic, utimes, self._plates.arrows(items[drawn], utimes), frames[drawn])
            else:
                yield self._logs(items, capture_utimes, timestamps_us)

    def _clouds(self, items: Items, utimes: list[int]) -> list[bytes]:
        """Return the visible markers of frames; each has its position in the parameters, from 0."""
        values = _floats(items).reshape(*items.shape, 4).astype(np.float32)
        points = np.empty((*items.shape, 5), "<f4")
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            points[..., :3] = self._frame.points(values[..., :3])
        points[..., 3] = values[..., 3]
        points.view("<u4")[..., 4] = np.arange(items.shape[1])
        is_finite: Any = np.isfinite(values[..., :3])
        if is_finite.all():  # then there is nothing to leave out, which is faster
            clouds = [frame.tobytes() for frame in points]
        else:
            # ``all`` over the three takes four times as long.
            is_visible = is_finite[..., 0] & is_finite[..., 1] & is_finite[..., 2]
            shown = zip(points, is_visible, strict=True)
            clouds = [frame[visible].tobytes() for frame, visible in shown]
        return [
            PointCloud(
                timestamp=timestamp(utime),
                frame_id=self._frame.frame_id,
                pose=NO_POSE,
                point_stride=_POINT.itemsize,
                fields=_POINT_FIELDS,
                data=cloud,
            ).encode()
            for cloud, utime in zip(clouds, utimes, strict=True)
        ]

    def _transforms(self, items: Items, utimes: list[int]) -> TopicMessages:
        """Return the poses of the visible tools, for the frames that have any.

        Without a transform, rerun would reject the messages before and after this one, too.
        """
        num_tools = items.shape[1]
        poses = self._frame.poses(items.reshape(-1))
        names = [f"{self.source}/{label}" for label in self._labels_of(ComponentType.TOOLS, num_tools)]
        messages: list[bytes] = []
        frames: list[int] = []
        for frame, utime in enumerate(utimes):
            time = timestamp(utime)
            transforms = [
                FrameTransform(
                    timestamp=time,
                    parent_frame_id=self._frame.frame_id,
                    child_frame_id=name,
                    translation=Vector3(x=pose[0], y=pose[1], z=pose[2]),
                    rotation=Quaternion(x=pose[3], y=pose[4], z=pose[5], w=pose[6]),
                )
                for name, pose in zip(names, poses[frame * num_tools :], strict=False)
                if pose is not None
            ]
            if transforms:
                messages.append(FrameTransforms(transforms=transforms).encode())
                frames.append(frame)
        return TopicMessages(self._fixed.tools, [utimes[frame] for frame in frames], messages, frames)

    def _new_records(self, component: ComponentType, num_items: int) -> dict[FoxgloveTopic, FloatRecord]:
        """Return the topics of a component's values by their labels; {} if there are none or too many."""
        if not 0 < num_items * NUMBERS_PER_ITEM[component] <= MAX_FIELDS:
            return {}
        name, names = "analog", field_names(self._labels_of(component, num_items), FIELD_NOUNS[component])
        if component is ComponentType.FORCE:
            labels = [f"{plate}_{load}" for plate in names for load in _LOADS]
            name, names = "loads", field_names(labels, "load")
        return {record.topic: record for record in self._topics.records(name, names)}

    def _logs(self, items: Items, capture_utimes: list[int], timestamps_us: list[int]) -> TopicMessages:
        """Return the events, each at its own time stamp if that is plausible."""
        utimes: list[int] = []
        messages: list[bytes] = []
        frames: list[int] = []
        own_us = items["timestamp"].tolist()
        values = items[[*EVENT_VALUES]].tolist()
        for frame, (capture_utime, timestamp_us) in enumerate(
            zip(capture_utimes, timestamps_us, strict=True)
        ):
            for event_us, event in zip(own_us[frame], values[frame], strict=True):
                utime = min(max(event_time_us(capture_utime, timestamp_us, event_us), 0), MAX_UTIME)
                time, message = timestamp(utime), self._event_message(*event)
                log = Log(timestamp=time, level=LogLevel.Info, message=message, name=self.source)
                utimes.append(utime)
                messages.append(log.encode())
                frames.append(frame)
        return TopicMessages(self._fixed.events, utimes, messages, frames)

    def _find_event_message(self, *values: int) -> str:
        text = event_text(self._parameters, dict(zip(EVENT_VALUES, values, strict=True)))
        return f"{text.label} ({text.description})" if text.description else text.label

    def _find_labels(self, component: ComponentType, num_items: int) -> tuple[str, ...]:
        return describe(component, self._parameters, num_items).labels


def _floats(items: Items) -> Items:
    """Return the values of items, shape (…, values), as they are in memory."""
    return items.view(items.dtype[0]) if items.dtype.names else items
