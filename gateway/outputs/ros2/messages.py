"""The messages of ROS 2 in CDR. What is the same in all messages of a topic is encoded once.

The stamps are the results of ``cdr.stamp``. All positions are in metres.
"""

import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.outputs.ros2.cdr import ENCAPSULATION, CdrWriter

Array = npt.NDArray[Any]

_STAMP_BYTES: Final = 8
_COUNT: Final = struct.Struct("<I")
_COUNT_BYTES: Final = 4

pack_pose: Final = struct.Struct("<7d").pack
"""Encodes a geometry_msgs/Pose or Transform: x, y, z in m, and a quaternion x, y, z, w."""

pack_wrench: Final = struct.Struct("<6d").pack
"""Encodes a geometry_msgs/Wrench: force x, y, z in N, and torque x, y, z in Nm."""

_FLOAT32: Final = 7
_UINT32: Final = 6

POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("reliability", "<f4"), ("marker", "<u4")])
"""One point of a cloud: position, the server's reliability, and the marker's index."""

_POINT_TYPES: Final = {
    "x": _FLOAT32,
    "y": _FLOAT32,
    "z": _FLOAT32,
    "reliability": _FLOAT32,
    "marker": _UINT32,
}

MAX_LABEL_BYTES: Final = 16 * 1024
"""Longer labels of channels are left out, because they are in every message."""


class StampedEncoder:
    """Encodes geometry_msgs/PoseStamped and WrenchStamped of one frame."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id = CdrWriter(_STAMP_BYTES).string(frame_id).align(8).content

    def encode(self, stamp: bytes, content: bytes) -> bytes:
        """Return a message with the result of ``pack_pose`` or ``pack_wrench``."""
        return b"%b%b%b%b" % (ENCAPSULATION, stamp, self._frame_id, content)


class TransformNames:
    """The names in a geometry_msgs/TransformStamped, as the first transform of a message and as a later one.

    They are aligned differently: the first one begins after the number of transforms.
    """

    def __init__(self, frame_id: str, child_frame_id: str) -> None:
        names = (frame_id, child_frame_id)
        self.first = CdrWriter(_COUNT_BYTES + _STAMP_BYTES).strings(names).align(8).content
        self.later = CdrWriter(_STAMP_BYTES).strings(names).align(8).content


def tf_message(stamp: bytes, transforms: Sequence[tuple[TransformNames, bytes]]) -> bytes:
    """Return a tf2_msgs/TFMessage with the names and the ``pack_pose`` of each transform."""
    parts = [ENCAPSULATION, _COUNT.pack(len(transforms))]
    for names, pose in transforms:
        parts += (stamp, names.later if len(parts) > 2 else names.first, pose)
    return b"".join(parts)


class CloudEncoder:
    """Encodes sensor_msgs/PointCloud2 with one point per marker, in the order of the markers.

    A missing marker is a point of NaN, so that the index of a point is that of its marker.
    """

    def __init__(self, frame_id: str, num_markers: int) -> None:
        self._points = np.zeros(num_markers, POINT)
        self._points["marker"] = np.arange(num_markers)
        self._floats = self._points.view("<f4").reshape(num_markers, len(_POINT_TYPES))  # the same memory
        writer = CdrWriter(_STAMP_BYTES).string(frame_id).uint32(1, num_markers)  # height, width
        writer.uint32(len(_POINT_TYPES))
        for name, datatype in _POINT_TYPES.items():
            assert POINT.fields is not None  # noqa: S101 - for mypy: it has names
            writer.string(name).uint32(POINT.fields[name][1]).uint8(datatype).uint32(1)
        is_big_endian = 0
        writer.uint8(is_big_endian).uint32(POINT.itemsize, self._points.nbytes, self._points.nbytes)
        self._layout = writer.content

    @property
    def num_markers(self) -> int:
        """How many points its messages have."""
        return len(self._points)

    def encode(self, stamp: bytes, positions: Array, reliabilities: Array) -> bytes:
        """Return a message with ``positions``, shape (n, 3), in m. A point with any NaN is missing."""
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            self._floats[:, :3] = positions
        is_dense = bool(np.isfinite(self._floats[:, :3]).all())
        if not is_dense:
            self._floats[np.isnan(positions).any(axis=1), :3] = np.nan
        self._floats[:, 3] = reliabilities
        return b"".join((ENCAPSULATION, stamp, self._layout, self._points.tobytes(), bytes([is_dense])))


class AnalogEncoder:
    """Encodes std_msgs/Float32MultiArray with one value per channel.

    The label of its dimension has the labels of all channels, separated by commas.
    """

    def __init__(self, labels: Sequence[str]) -> None:
        label = ",".join(each.replace(",", "_") for each in labels)
        if len(label.encode(errors="replace")) > MAX_LABEL_BYTES:
            label = "channels"
        count, data_offset = len(labels), 0
        writer = CdrWriter().uint32(1).string(label).uint32(count, count).uint32(data_offset)
        self._layout = writer.uint32(count).content
        self.num_channels = count

    def encode(self, values: Array) -> bytes:
        """Return a message with ``values``, shape (num_channels,)."""
        return b"%b%b%b" % (ENCAPSULATION, self._layout, values.astype("<f4").tobytes())


class DiagnosticStatus(NamedTuple):
    """The values of a diagnostic_msgs/DiagnosticStatus: ``level`` is 0 OK, 1 WARN, 2 ERROR, 3 STALE."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]


def diagnostic_array(stamp: bytes, statuses: Iterable[DiagnosticStatus]) -> bytes:
    """Return a diagnostic_msgs/DiagnosticArray."""
    listed = list(statuses)
    writer = CdrWriter().raw(stamp).string("").uint32(len(listed))
    for status in listed:
        writer.uint8(status.level).strings((status.name, status.message, status.hardware_id))
        writer.uint32(len(status.values))
        for key, value in status.values.items():
            writer.string(key).string(value)
    return ENCAPSULATION + writer.content
