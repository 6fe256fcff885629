"""The topics of one source on ROS 2, and the messages that each frame becomes there."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from gateway.messages.coordinate_frame import NO_ROTATION, Quaternion, Vector, with_offset
from gateway.messages.descriptions.labels import describe, event_time_us
from gateway.messages.descriptions.source_frame import quaternion_of, unknown_unit_text
from gateway.messages.host_time import now_utime
from gateway.messages.ros2.encode import (
    DIAGNOSTIC_ARRAY,
    FLOAT_ARRAY,
    POINT_CLOUD,
    POINT_STAMPED,
    POSE_STAMPED,
    WRENCH_STAMPED,
    AnalogEncoder,
    CloudEncoder,
    RosType,
    StampedEncoder,
    TransformNames,
    pack_point,
    pack_pose,
    pack_wrench,
    ros_stamp,
    tf_message,
)
from gateway.messages.ros2.events import event_message
from gateway.messages.ros2.labels import MAX_LABELS, Labels, by_index, labels_message
from gateway.messages.ros2.names import (
    ANALOG,
    EVENTS,
    MARKERS,
    plate_name,
    pose_topic,
    pressure_topic,
    unique_ros_names,
    wrench_topic,
)
from gateway.messages.ros2.plates import RosPlate, ros_plates, transforms_of
from gateway.outputs.adapters.ros2.latched import LatchedTopic, StaticTransforms
from gateway.outputs.adapters.ros2.settings import OffsetSettings, Tool
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import (
    COMPONENT_HEADER_BYTES,
    ITEM_DTYPES,
    ByteOrder,
    Component,
    ComponentType,
    Items,
)
from gateway.rtc3d.frames import RawFrame
from gateway.runtime.losses import Losses

MAX_TOOLS: Final = 256
MAX_PLATES: Final = 64
"""How many tools and plates can have topics of their own. The server determines how many there are."""

MAX_EVENTS: Final = 256
"""How many events of a frame are published: each becomes a message. Usually, there is one."""

NO_PARAMETERS: Final = ServerParameters(b"", 0, 0, components=frozenset())
"""Stands for the parameters before the first are there."""

_ITEMS_OFFSET: Final = COMPONENT_HEADER_BYTES - 8
"""Of the items in a component's content, which begins after its size and type."""

_LENGTH_COMPONENTS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)

Messages = list[tuple[RosTopic, bytes]]
"""Topics, and what to publish on them."""


class _Tool(NamedTuple):
    topic: RosTopic
    names: TransformNames
    offset: tuple[Vector, Quaternion] | None  # None costs nothing


def _offset_of(tool: Tool | None) -> tuple[Vector, Quaternion] | None:
    if not tool or tool.offset == OffsetSettings():
        return None
    offset = tool.offset
    return offset.translation_m, offset.rotation_xyzw or quaternion_of(offset.rotation_deg)


class _Plate(NamedTuple):
    described: RosPlate
    wrench: RosTopic
    pressure: RosTopic | None  # if its place is known

    @property
    def topics(self) -> list[RosTopic]:
        return [self.wrench] if self.pressure is None else [self.wrench, self.pressure]


class SourceTopics:
    """The topics of one source. Only the sending thread calls its methods.

    ``name`` is the source's name in the configuration, ``base`` the beginning of its topics: /mocap/lab.
    ``tf`` is the topic /tf, which all sources share, and ``static`` has /tf_static. There, frames of tools
    and plates begin with the source's name, so that they differ even if sources have one frame: lab/wand.
    ``labels`` is the topic of labels; its subscribers need no frames. ``tools`` has those, by label, that are
    called otherwise or are left out. ``on_wanted_changed`` is called in any thread when subscribers come or
    go, or topics. ``losses`` returns where to count what cannot be published.
    """

    def __init__(
        self,
        name: str,
        base: str,
        tf: RosTopic,
        static: StaticTransforms,
        labels: LatchedTopic,
        tools: Mapping[str, Tool],
        on_wanted_changed: Callable[[], None],
        losses: Callable[[], Losses],
    ) -> None:
        # These three are replaced, not changed, because any thread may read them.
        self.all: tuple[RosTopic, ...] = ()
        """All topics but /tf and that of labels."""
        self.by_component: Mapping[ComponentType, Sequence[RosTopic]] = {ComponentType.TOOLS: (tf,)}
        """The topics on which each component is published."""
        self.names: Mapping[str, Mapping[str, str]] = {}
        """The parts of topics by component key and label, where they differ."""
        self._source = name
        self._base = base
        self._tf = tf
        self._static = static
        self._labels_topic = labels
        self._labels: Labels = {}  # of the newest message
        self._settings = tools  # by label
        self._chosen_names = {label: tool.name for label, tool in tools.items() if tool and tool.name}
        self._on_wanted_changed = on_wanted_changed
        self._losses = losses
        self._node: RosNode | None = None
        self._by_name: dict[str, RosTopic] = {}
        self._former: dict[str, RosTopic] = {}  # those that the newest parameters may need again
        self._begin_with(NO_PARAMETERS)

    def declare(self, node: RosNode) -> None:
        """Declare all topics, now and later, on an open session."""
        self._node = node
        self._labels_topic.declare(node)
        for topic in self._by_name.values():
            topic.declare(node)

    def undeclare(self) -> None:
        """Remove all topics from ROS."""
        for topic in self._by_name.values():
            topic.undeclare()
        self._labels_topic.undeclare()
        self._static.set_transforms(self._source, ())
        self._by_name = {}
        self.by_component = {}
        self.all = ()

    def check_subscribers(self) -> None:
        """Check again for subscribers."""
        for topic in self.all:
            topic.check_subscribers()

    def use(self, parameters: ServerParameters) -> None:
        """Open the topics that belong to the parameters, and close others. The same ones change nothing."""
        if parameters is self._described_by:
            return
        self._former, self._by_name = self._by_name, {}
        self._begin_with(parameters)
        parsed = parameters.parsed
        self.open(
            {
                ComponentType.MARKERS: len(parsed.markers.markers) if parsed.markers else 0,
                ComponentType.TOOLS: len(parsed.tools.tools) if parsed.tools else 0,
                ComponentType.ANALOG: len(parsed.analog.channels) if parsed.analog else 0,
                ComponentType.FORCE: len(parsed.force.plates) if parsed.force else 0,
                ComponentType.EVENT: len(parsed.events.events) if parsed.events else 0,
            }
        )
        for topic in self._former.values():
            topic.undeclare()
        self._former = {}
        self._static.set_transforms(self._source, transforms_of([plate.described for plate in self._plates]))

    def _begin_with(self, parameters: ServerParameters) -> None:
        self._described_by = parameters
        self._frame = parameters.frame
        self._stamped = StampedEncoder(self._frame.frame_id)
        self._cloud = CloudEncoder(self._frame.frame_id, 0)
        self._channels = AnalogEncoder(())
        self._markers: RosTopic | None = None
        self._analog: RosTopic | None = None
        self._events: RosTopic | None = None
        self._tools: list[_Tool | None] = []  # None is one that is left out
        self._plates: list[_Plate] = []
        self._labels_now: Labels = {}
        self.names = {}

    def open(self, counts: Mapping[ComponentType, int]) -> None:
        """Open the topics of frames with so many items, even if the parameters do not mention them."""
        if counts.get(ComponentType.MARKERS):
            self._markers = self._topic(MARKERS, POINT_CLOUD)
        if counts.get(ComponentType.ANALOG):
            self._analog = self._topic(ANALOG, FLOAT_ARRAY)
        if counts.get(ComponentType.EVENT):
            self._events = self._topic(EVENTS, DIAGNOSTIC_ARRAY)
        for component in (ComponentType.MARKERS, ComponentType.ANALOG):
            num_items = min(counts.get(component, 0), MAX_LABELS)
            if num_items > len(self._labels_now.get(component, ())):
                labels = describe(component, self._described_by.parsed, num_items).labels
                self._labels_now[component] = by_index(labels)
        num_tools = min(counts.get(ComponentType.TOOLS, 0), MAX_TOOLS)
        if num_tools > len(self._tools):
            self._open_tools(num_tools)
        num_plates = min(counts.get(ComponentType.FORCE, 0), MAX_PLATES)
        if num_plates > len(self._plates):
            self._open_plates(num_plates)
        self._publish_labels()
        self.all = tuple(self._by_name.values())
        self.by_component = {
            ComponentType.TOOLS: (self._tf, *(tool.topic for tool in self._tools if tool is not None)),
            ComponentType.FORCE: tuple(topic for plate in self._plates for topic in plate.topics),
            ComponentType.MARKERS: () if self._markers is None else (self._markers,),
            ComponentType.ANALOG: () if self._analog is None else (self._analog,),
            ComponentType.EVENT: () if self._events is None else (self._events,),
        }
        self._on_wanted_changed()  # a subscriber may have come before a topic was among them

    def _open_tools(self, num_tools: int) -> None:
        labels = describe(ComponentType.TOOLS, self._described_by.parsed, num_tools).labels
        names = unique_ros_names(labels, "tool", self._chosen_names)
        named = [*zip(labels, names, strict=True)]
        for label, name in named[len(self._tools) :]:
            self._tools.append(None if self._is_left_out(label) else self._new_tool(label, name))
        self._show_names(ComponentType.TOOLS, [each for each in named if not self._is_left_out(each[0])])

    def _is_left_out(self, label: str) -> bool:
        return self._settings.get(label) is False

    def _new_tool(self, label: str, name: str) -> _Tool:
        tool = self._settings.get(label)
        child_frame = (tool and tool.child_frame) or f"{self._source}/{name}"
        topic = self._topic(pose_topic(name), POSE_STAMPED)
        return _Tool(topic, TransformNames(self._frame.frame_id, child_frame), _offset_of(tool))

    def _open_plates(self, num_plates: int) -> None:
        parsed = self._described_by.parsed
        plates = ros_plates(parsed, self._frame, self._source, num_plates)
        names = [*map(plate_name, range(1, num_plates + 1))]
        for name, plate in [*zip(names, plates, strict=False)][len(self._plates) :]:
            wrench = self._topic(wrench_topic(name), WRENCH_STAMPED)
            pressure = None if plate.frame is None else self._topic(pressure_topic(name), POINT_STAMPED)
            self._plates.append(_Plate(plate, wrench, pressure))
        labels = describe(ComponentType.FORCE, parsed, num_plates).labels
        self._show_names(ComponentType.FORCE, [*zip(labels, names, strict=True)])

    def _show_names(self, component: ComponentType, named: Sequence[tuple[str, str]]) -> None:
        changed = {label: name for label, name in named if name != label}
        self.names = {**self.names, component.key: changed}
        self._labels_now[component] = {name: label for label, name in named}

    def _publish_labels(self) -> None:
        """Publish the labels if they have changed. Their stamp says since when they are valid."""
        if self._labels_now != self._labels:
            self._labels = dict(self._labels_now)
            stamp = ros_stamp(now_utime())
            encode = functools.partial(labels_message, stamp, self._source, self._labels)
            self._labels_topic.set_message(functools.cache(encode) if self._labels else None)

    def _topic(self, name: str, ros_type: RosType) -> RosTopic:
        """Return the topic with this name: one that is open already, or a new one."""
        path = f"{self._base}/{name}"
        topic = self._by_name.get(path) or self._former.pop(path, None)
        if topic is None:
            topic = RosTopic(path, ros_type, self._on_wanted_changed)
            if self._node is not None:
                topic.declare(self._node)
        self._by_name[path] = topic
        return topic

    # Frames.

    def encode(
        self, frame: RawFrame, utime: int, components: frozenset[ComponentType], encoded: Messages
    ) -> None:
        """Append the messages of a frame to ``encoded``, on the topics that have subscribers.

        ``utime`` is when it was captured, in µs since the Unix epoch. If it raises an exception, those that
        are complete have been appended.
        """
        stamp = ros_stamp(utime)
        for index, layout in enumerate(frame.layout.components):
            kind = layout.type
            if kind not in components:
                continue
            if kind in _LENGTH_COMPONENTS and self._frame.metres_per_unit is None:
                self._count_unknown_unit(kind)
            elif kind is ComponentType.TOOLS:
                self._encode_tools(_items(frame, index), stamp, encoded)
            elif kind is ComponentType.MARKERS and self._markers is not None and self._markers.wanted:
                self._encode_markers(self._markers, _items(frame, index), stamp, encoded)
            elif kind is ComponentType.FORCE:
                self._encode_forces(_items(frame, index), stamp, encoded)
            elif kind is ComponentType.ANALOG and self._analog is not None and self._analog.wanted:
                self._encode_analog(self._analog, _items(frame, index), encoded)
            elif kind is ComponentType.EVENT and self._events is not None and self._events.wanted:
                self._encode_events(self._events, frame.component(index), utime, encoded)

    def _encode_tools(self, items: Items, stamp: bytes, encoded: Messages) -> None:
        is_tf_wanted = self._tf.wanted
        if not (is_tf_wanted or any(tool.topic.wanted for tool in self._tools if tool)):
            return
        self._count_too_many("tools", len(items), MAX_TOOLS)
        head = self._stamped.head(stamp)
        transforms = []
        poses = self._frame.poses(items[: len(self._tools)])
        for tool, pose in zip(self._tools, poses, strict=False):  # a frame can have fewer tools
            if pose is None or tool is None:  # out of view, or left out
                continue
            topic, names, offset = tool
            if offset is not None:
                pose = with_offset(pose, *offset)  # noqa: PLW2901 - as the frame of the tool is published
            content = pack_pose(*pose[:7])
            transforms.append((names, content))
            if topic.wanted:
                encoded.append((topic, head + content))
        if is_tf_wanted and transforms:
            encoded.append((self._tf, tf_message(stamp, transforms)))

    def _encode_markers(self, topic: RosTopic, items: Items, stamp: bytes, encoded: Messages) -> None:
        if self._cloud.num_markers != len(items):
            self._cloud = CloudEncoder(self._frame.frame_id, len(items))
        values = items.view(items.dtype["x"]).reshape(-1, 4)
        cloud = self._cloud.encode(stamp, self._frame.points(values[:, :3]), values[:, 3])
        encoded.append((topic, cloud))

    def _encode_forces(self, items: Items, stamp: bytes, encoded: Messages) -> None:
        if not any(topic.wanted for plate in self._plates for topic in plate.topics):
            return
        self._count_too_many("force plates", len(items), MAX_PLATES)
        loads = turned = items[: len(self._plates)].tolist()
        if self._frame.rotation_xyzw != NO_ROTATION:
            turned = self._frame.vectors(np.array(loads).reshape(-1, 3)).reshape(-1, 6).tolist()
        for ((n, nm, frame), topic, pressure), load, (fx, fy, fz, mx, my, mz) in zip(
            self._plates, loads, turned, strict=False
        ):
            if any(map(math.isnan, load)):
                continue
            if topic.wanted:
                stamped = self._stamped if frame is None else frame.stamped
                wrench = pack_wrench(fx * n, fy * n, fz * n, mx * nm, my * nm, mz * nm)
                encoded.append((topic, stamped.encode(stamp, wrench)))
            if frame is not None and pressure is not None and pressure.wanted:
                centre = frame.centre_of_pressure(load)
                if centre is not None:  # without contact, there is none
                    encoded.append((pressure, self._stamped.encode(stamp, pack_point(*centre))))

    def _encode_analog(self, topic: RosTopic, items: Items, encoded: Messages) -> None:
        if self._channels.num_channels != len(items):
            labels = describe(ComponentType.ANALOG, self._described_by.parsed, len(items)).labels
            self._channels = AnalogEncoder(labels)
        encoded.append((topic, self._channels.encode(items)))

    def _encode_events(self, topic: RosTopic, events: Component, utime: int, encoded: Messages) -> None:
        """Append a message for each event, with the time of the event."""
        items = events.items()
        self._count_too_many("events", len(items), MAX_EVENTS)
        has_times = "timestamp" in (items.dtype.names or ())
        for event in items[:MAX_EVENTS]:
            event_us = int(event["timestamp"]) if has_times else events.timestamp_us
            happened_utime = event_time_us(utime, events.timestamp_us, event_us)
            message = event_message(self._source, self._described_by.parsed, event, happened_utime)
            encoded.append((topic, message))

    def _count_unknown_unit(self, kind: ComponentType) -> None:
        num_messages = sum(topic.wanted for topic in self.by_component.get(kind, ()))
        if num_messages:
            text = unknown_unit_text(self._described_by.parsed)
            self._losses().lost("unknown unit", text, messages=num_messages)

    def _count_too_many(self, noun: str, count: int, most: int) -> None:
        if count > most:
            text = f"a frame has {count} {noun}; only the first {most} are published"
            self._losses().lost(f"too many {noun}", text, messages=count - most)


_BYTE_ORDERS: Final[tuple[ByteOrder, ...]] = ("big", "little")
_DTYPES: Final = {
    byte_order: {kind: dtype.newbyteorder(byte_order) for kind, dtype in ITEM_DTYPES.items()}
    for byte_order in _BYTE_ORDERS
}


def _items(frame: RawFrame, index: int) -> Items:
    """Return the items of a component, unless they are events, shape (items,).

    That takes a fifth of the time of ``frame.component(index).items()``, which copies the content.
    """
    layout = frame.layout
    component = layout.components[index]
    start, _ = layout.content_spans[index]
    dtype = _DTYPES[layout.byte_order][component.type]
    return np.frombuffer(frame.body, dtype, component.num_items, start + _ITEMS_OFFSET)
