"""Export to a bag of ROS 2: an MCAP file with the messages that the output ``ros2`` publishes live."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.labels import event_time_us
from gateway.messages.encode import metres_per_unit
from gateway.messages.foxglove.topics import MAX_UTIME, FoxgloveTopic, TopicMessages
from gateway.messages.ros2.definitions import definition
from gateway.messages.ros2.encode import (
    DIAGNOSTIC_ARRAY,
    FLOAT_ARRAY,
    POINT_CLOUD,
    POINT_STAMPED,
    POSE_STAMPED,
    TF_MESSAGE,
    WRENCH_STAMPED,
    AnalogEncoder,
    CloudEncoder,
    RosType,
    StampedEncoder,
    TransformNames,
    pack_pose,
    ros_stamp,
    ros_stamps,
    tf_message,
)
from gateway.messages.ros2.events import event_message
from gateway.messages.ros2.labels import Labels, by_index, labels_message
from gateway.messages.ros2.names import (
    ANALOG,
    DEFAULT_NAMESPACE,
    EVENTS,
    LABELS,
    MARKERS,
    MAX_PART_CHARS,
    TF,
    TF_STATIC,
    plate_name,
    pose_topic,
    pressure_topic,
    ros_name,
    unique_ros_names,
    wrench_topic,
)
from gateway.messages.ros2.plates import PlateFrame, RosPlate, ros_plates, transforms_of
from gateway.messages.topics import unique_name
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.export.job import ExportJob
from gateway.takes.export.mcap_file import SourceExport, export_to_mcap
from gateway.takes.export.plates import unit_notes
from gateway.takes.export.source_frame import frame_of
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series
from gateway.takes.files.take import TakeSource

_PROFILE: Final = "ros2"


def export_rosbag(job: ExportJob) -> None:
    """Write the sources of a take to one bag, with the topics of the output ``ros2``."""
    taken: set[str] = set()

    def new_export(source: TakeSource) -> SourceExport:
        name = unique_name(ros_name(source.name, "source"), taken, MAX_PART_CHARS)
        taken.add(name)
        if source.frame and not source.frame.only_scales:
            job.note(
                f"positions of {source.name} are in the frame {source.frame.frame_id} of its newest status"
            )
        return _RosExport(source, name)

    export_to_mcap(job, new_export, "markers, tools, analog channels, forces or events", _PROFILE)


class _RosExport(SourceExport):
    """One source: what its frames become. ``name`` is the part of its topics that stands for it."""

    def __init__(self, source: TakeSource, name: str) -> None:
        super().__init__()
        self._source = source.name
        self._frame = frame_of(source)
        self._base = f"/{DEFAULT_NAMESPACE}/{name}"
        self._stamped = StampedEncoder(self._frame.frame_id)
        self._topics: dict[tuple[str, RosType], FoxgloveTopic] = {}
        self._placed_by: Parameters | None = None  # those that /tf_static follows
        self._labels: Labels = {}  # of the newest message

    def messages_of(self, key: str, run: Series, rows: Array) -> Iterable[TopicMessages]:
        """Return the messages of a component, and the labels before those that need them."""
        found = [*self._values_of(key, run, rows)]
        if run.labels and any(each.messages for each in found):
            yield from self._label_messages(run, int(run.capture_utime[rows][0]))
        yield from found

    def _label_messages(self, run: Series, utime: int) -> Iterable[TopicMessages]:
        """Return the labels of all components so far, if those of a run are new.

        Nodes keep the newest message only.
        """
        names: Sequence[str]
        match run.component:
            case ComponentType.TOOLS:
                names = self.labels_of(run)
            case ComponentType.FORCE:
                names = [plate_name(number) for number in range(1, len(run.labels) + 1)]
            case _:
                names = [*by_index(run.labels)]
        labels = dict(zip(names, run.labels, strict=False))
        if labels != self._labels.get(run.component):
            self._labels[run.component] = labels
            encoded = labels_message(ros_stamp(utime), self._source, self._labels)
            topic = self._topic(f"{self._base}/{LABELS}", DIAGNOSTIC_ARRAY)
            yield TopicMessages(topic, [utime], [encoded])

    def _values_of(self, key: str, run: Series, rows: Array) -> Iterable[TopicMessages]:
        match key:
            case "3d":
                return self._markers(run, rows)
            case "6d":
                return self._tools(run, rows)
            case "analog":
                encoded = AnalogEncoder(run.labels).encode_rows(run.items[rows])
                return [self._messages(ANALOG, FLOAT_ARRAY, run.capture_utime[rows], encoded)]
            case "force":
                return self._forces(run, rows)
        return [self._events(run, rows)]

    def labels_of(self, run: Series) -> Sequence[str]:
        """Return the names of topics of tools; other labels stay, or are in no message."""
        return unique_ros_names(run.labels, "tool") if run.component is ComponentType.TOOLS else run.labels

    def _frame_of(self, run: Series) -> CoordinateFrame:
        """Return the coordinate frame with the unit of a run, and the scale of the settings."""
        metres = metres_per_unit(run.unit)
        return replace(self._frame, metres_per_unit=None if metres is None else metres * self._frame.scale)

    def _markers(self, run: Series, rows: Array) -> list[TopicMessages]:
        frame = self._frame_of(run)
        if frame.metres_per_unit is None:
            self.count(f"markers with the unknown unit {run.unit!r}", rows >= 0)
            return []
        utimes, markers = run.capture_utime[rows], run.values[rows]
        encoder = CloudEncoder(frame.frame_id, markers.shape[1])
        positions = frame.points(markers[..., :3])
        encoded = encoder.encode_rows(ros_stamps(utimes), positions, markers[..., 3])
        return [self._messages(MARKERS, POINT_CLOUD, utimes, encoded)]

    def _tools(self, run: Series, rows: Array) -> list[TopicMessages]:
        """Return the pose of each tool, and /tf with all tools that are in view in a frame."""
        frame = self._frame_of(run)
        if frame.metres_per_unit is None:
            self.count(f"tools with the unknown unit {run.unit!r}", rows >= 0)
            return []
        tools = self.labels_of(run)
        names = [TransformNames(frame.frame_id, f"{self._source}/{tool}") for tool in tools]
        topics = [self._topic(f"{self._base}/{pose_topic(tool)}", POSE_STAMPED) for tool in tools]
        found = [TopicMessages(topic, [], []) for topic in topics]
        tf = TopicMessages(self._topic(TF, TF_MESSAGE), [], [])
        for row, utime in zip(rows.tolist(), run.capture_utime[rows].tolist(), strict=True):
            stamp = ros_stamp(utime)
            transforms = []
            for index, pose in enumerate(frame.poses(run.items[row])):
                if pose is not None:
                    packed = pack_pose(*pose[:7])
                    transforms.append((names[index], packed))
                    found[index].utimes.append(utime)
                    found[index].messages.append(self._stamped.encode(stamp, packed))
            if transforms:
                tf.utimes.append(utime)
                tf.messages.append(tf_message(stamp, transforms))
        return [*found, tf]

    def _forces(self, run: Series, rows: Array) -> Iterable[TopicMessages]:
        parameters, num_plates = run.parameters_of(0), run.values.shape[1]
        self.notes |= dict.fromkeys(
            unit_notes(parameters.force.plates[:num_plates] if parameters.force else ())
        )
        plates = ros_plates(parameters, self._frame, self._source, num_plates)
        if len(rows) and parameters is not self._placed_by:
            self._placed_by = parameters
            yield from self._static_transforms(plates, int(run.capture_utime[rows][0]))
        for index, (newtons, newton_metres, frame) in enumerate(plates[:num_plates]):
            name = plate_name(index + 1)
            values = run.values[rows, index]
            is_known = ~np.asarray(np.isnan(values).any(axis=1))
            self.count("forces with NaN", ~is_known)
            values, utimes = values[is_known], run.capture_utime[rows][is_known]
            loads = values * np.array([newtons] * 3 + [newton_metres] * 3)
            loads = self._frame.vectors(loads.reshape(-1, 2, 3)).reshape(-1, 6)
            stamped = self._stamped if frame is None else frame.stamped
            encoded = stamped.encode_rows(ros_stamps(utimes), loads)
            yield self._messages(wrench_topic(name), WRENCH_STAMPED, utimes, encoded)
            if frame is not None:
                yield self._pressure(pressure_topic(name), frame, values, utimes)

    def _events(self, run: Series, rows: Array) -> TopicMessages:
        """Return the events, each with its own time."""
        found = TopicMessages(self._topic(f"{self._base}/{EVENTS}", DIAGNOSTIC_ARRAY), [], [])
        times = (run.capture_utime[rows], run.timestamp_us[rows], run.items["timestamp"][rows])
        for row, *row_times in zip(rows.tolist(), *(each.tolist() for each in times), strict=True):
            utime = min(max(event_time_us(*row_times), 0), MAX_UTIME)
            found.utimes.append(utime)
            encoded = event_message(self._source, run.parameters_of(row), run.items[row], utime)
            found.messages.append(encoded)
        return found

    def _static_transforms(self, plates: Sequence[RosPlate], utime: int) -> Iterable[TopicMessages]:
        """Return where the plates are, if that is known."""
        if transforms := transforms_of(plates):
            message = tf_message(ros_stamp(utime), transforms)
            yield TopicMessages(self._topic(TF_STATIC, TF_MESSAGE), [utime], [message])

    def _pressure(self, topic: str, frame: PlateFrame, loads: Array, utimes: Array) -> TopicMessages:
        """Return the centres of pressure of loads, shape (rows, 6), without those of no contact."""
        has_contact, points = frame.centres_of_pressure(loads)
        utimes = utimes[has_contact]
        encoded = self._stamped.encode_rows(ros_stamps(utimes), points)
        return self._messages(topic, POINT_STAMPED, utimes, encoded)

    def _messages(self, name: str, ros_type: RosType, utimes: Array, encoded: list[bytes]) -> TopicMessages:
        return TopicMessages(self._topic(f"{self._base}/{name}", ros_type), utimes.tolist(), encoded)

    def _topic(self, path: str, ros_type: RosType) -> FoxgloveTopic:
        if (path, ros_type) not in self._topics:
            schema = definition(ros_type).encode()
            self._topics[path, ros_type] = FoxgloveTopic(path, "cdr", ros_type.name, "ros2msg", schema)
        return self._topics[path, ros_type]
