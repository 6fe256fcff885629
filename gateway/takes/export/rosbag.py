"""Export to a bag of ROS 2: an MCAP file with the messages that the output ``ros2`` publishes live.

The file is written while the take is read, so its size does not matter. Whole blocks of frames are encoded
at once, because a Python call for each message would take several times as long.
"""

from collections import Counter
from collections.abc import Iterable
from typing import Final

import numpy as np

from gateway.descriptions.force_plates import units_of
from gateway.foxglove_schemas.topics import MAX_UTIME, FoxgloveMessage, Topic
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import metres_per_unit
from gateway.messages.ros2 import (
    FLOAT_ARRAY,
    POINT_CLOUD,
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
from gateway.messages.ros2_definitions import definition
from gateway.messages.ros2_names import (
    ANALOG,
    DEFAULT_NAMESPACE,
    MARKERS,
    MAX_PART_CHARS,
    TF,
    plate_name,
    pose_topic,
    ros_name,
    unique_ros_names,
    wrench_topic,
)
from gateway.messages.topics import unique_name
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.export.mcap import McapFile, note_metres
from gateway.takes.export.tables import parts_of
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series

_PROFILE: Final = "ros2"


def export_rosbag(job: ExportJob) -> None:
    """Write the sources of a take to one bag, with the topics of the output ``ros2``."""
    take = job.open_take(components=())
    note_metres(job, take)
    sources: dict[str, _SourceTopics] = {}
    with McapFile(job.files.create(job.out), profile=_PROFILE) as file:
        for name, key, series in parts_of(job, take):
            if name not in sources:
                taken = {source.name for source in sources.values()}
                sources[name] = _SourceTopics(
                    name, unique_name(ros_name(name, "source"), taken, MAX_PART_CHARS)
                )
            for run in series.runs():
                for message in sources[name].messages(key, run):
                    file.write(message)
        for each in take.sources.values():
            file.write_metadata(each)
    if not file.num_messages:
        raise nothing_to_export(job, "markers, tools, analog channels or forces")
    job.note_malformed(take)
    for name, source in sources.items():
        for what, count in source.left_out.items():
            job.note(f"{what} of {name} left out", job.out.name, count)
        for what in source.changed:
            job.note(what)


class _SourceTopics:
    """The topics of one source: what the frames of a run become."""

    def __init__(self, source: str, name: str) -> None:
        self.name = name
        """The part of its topics that stands for the source."""
        self.left_out: Counter[str] = Counter()
        """How many messages or items were left out, by what they are."""
        self.changed: dict[str, None] = {}
        """What was changed."""
        self._source = source
        self._base = f"/{DEFAULT_NAMESPACE}/{name}"
        self._stamped = StampedEncoder(source)
        self._topics: dict[tuple[str, RosType], Topic] = {}

    def messages(self, key: str, run: Series) -> Iterable[FoxgloveMessage]:
        """Return the messages of frames with constant labels and units."""
        is_valid = (run.capture_utime >= 0) & (run.capture_utime <= MAX_UTIME)
        self._count(f"messages from before 1970 or after 2106 in {key}", ~is_valid)
        (rows,) = np.nonzero(is_valid)
        match key:
            case "3d":
                return self._markers(run, rows)
            case "6d":
                return self._tools(run, rows)
            case "analog":
                encoded = AnalogEncoder(run.labels).encode_rows(run.items[rows])
                return self._logged(ANALOG, FLOAT_ARRAY, run.capture_utime[rows], encoded)
            case "force":
                return self._forces(run, rows)
        self._count("events", is_valid)
        return ()

    def _markers(self, run: Series, rows: Array) -> Iterable[FoxgloveMessage]:
        metres = metres_per_unit(run.unit)
        if metres is None:
            self._count(f"markers with the unknown unit {run.unit!r}", rows >= 0)
            return ()
        utimes, markers = run.capture_utime[rows], run.values[rows]
        encoder = CloudEncoder(self._source, markers.shape[1])
        positions = markers[..., :3].astype(np.float64) * metres
        encoded = encoder.encode_rows(ros_stamps(utimes), positions, markers[..., 3])
        return self._logged(MARKERS, POINT_CLOUD, utimes, encoded)

    def _tools(self, run: Series, rows: Array) -> Iterable[FoxgloveMessage]:
        """Yield /tf with all tools that are in view in a frame, and the pose of each of them."""
        frame = CoordinateFrame(self._source, metres_per_unit(run.unit))
        if frame.metres_per_unit is None:
            self._count(f"tools with the unknown unit {run.unit!r}", rows >= 0)
            return
        tools = unique_ros_names(run.labels, "tool")
        if [*tools] != [*run.labels]:
            self.changed["labels of tools changed to names of topics"] = None
        names = [TransformNames(self._source, f"{self._source}/{tool}") for tool in tools]
        topics = [self._topic(f"{self._base}/{pose_topic(tool)}", POSE_STAMPED) for tool in tools]
        tf = self._topic(TF, TF_MESSAGE)
        for row, utime in zip(rows.tolist(), run.capture_utime[rows].tolist(), strict=True):
            stamp = ros_stamp(utime)
            poses = enumerate(frame.poses(run.items[row]))
            packed = [(index, pack_pose(*pose[:7])) for index, pose in poses if pose is not None]
            for index, pose in packed:
                yield FoxgloveMessage(topics[index], utime, self._stamped.encode(stamp, pose))
            if packed:
                transforms = [(names[index], pose) for index, pose in packed]
                yield FoxgloveMessage(tf, utime, tf_message(stamp, transforms))

    def _forces(self, run: Series, rows: Array) -> Iterable[FoxgloveMessage]:
        force = run.parameters_of(0).force
        plates = force.plates if force else ()
        for index in range(run.values.shape[1]):
            newtons, newton_metres = units_of(plates[index]) if index < len(plates) else (1.0, 1.0)
            loads = run.values[rows, index] * np.array([newtons] * 3 + [newton_metres] * 3)
            is_known = ~np.isnan(loads).any(axis=1)
            self._count("forces with NaN", ~is_known)
            if (newtons, newton_metres) != (1.0, 1.0):
                self.changed["forces and moments converted to N and N.m"] = None
            utimes = run.capture_utime[rows][is_known]
            encoded = self._stamped.encode_rows(ros_stamps(utimes), loads[is_known])
            yield from self._logged(wrench_topic(plate_name(index + 1)), WRENCH_STAMPED, utimes, encoded)

    def _logged(
        self, name: str, ros_type: RosType, utimes: Array, encoded: list[bytes]
    ) -> Iterable[FoxgloveMessage]:
        topic = self._topic(f"{self._base}/{name}", ros_type)
        return map(FoxgloveMessage, [topic] * len(encoded), utimes.tolist(), encoded)

    def _topic(self, path: str, ros_type: RosType) -> Topic:
        if (path, ros_type) not in self._topics:
            schema = definition(ros_type).encode()
            self._topics[path, ros_type] = Topic(path, "cdr", ros_type.name, "ros2msg", schema)
        return self._topics[path, ros_type]

    def _count(self, what: str, rows: Array) -> None:
        count = int(rows.sum())
        if count:
            self.left_out[what] += count
