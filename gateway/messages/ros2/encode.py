"""The messages of ROS 2 in CDR. What is the same in all messages of a topic is encoded once.

Four bytes say so (ENCAPSULATION). Each value is aligned to its own size, counted from the end of these four
bytes. A string is its length with the final NUL (uint32), its UTF-8 bytes, and the NUL. A sequence is its
length (uint32) and its items.

A test compares the hashes with those that rosbags computes from the definitions (REP 2011). They are the same
in all distributions since Iron.

The stamps are the results of ``ros_stamp``. All positions are in metres.
"""

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from gateway.messages.encode import split_rows

ENCAPSULATION: Final = b"\x00\x01\x00\x00"
"""The first bytes of every message: CDR version 1, little-endian, no options."""

MAX_STAMP_S: Final = (1 << 31) - 1
"""The seconds of builtin_interfaces/Time are an int32."""

_UINT32_STRUCT: Final = struct.Struct("<I")
_STAMP: Final = struct.Struct("<iI")


def ros_stamp(utime: int) -> bytes:
    """Return a builtin_interfaces/Time for a time in µs since the Unix epoch, moved into its range."""
    seconds, microseconds = divmod(utime, 1_000_000)
    return _STAMP.pack(max(-MAX_STAMP_S - 1, min(seconds, MAX_STAMP_S)), 1000 * microseconds)


class CdrWriter:
    """Appends values, with the padding that each of them needs.

    ``offset`` is where the first value will be in the message, not counting ENCAPSULATION, if only a part of
    a message is written. ``content`` is what has been written, from there on.
    """

    def __init__(self, offset: int = 0) -> None:
        self._first = offset
        self._parts: list[bytes] = []
        self._offset = offset

    @property
    def content(self) -> bytes:
        """The bytes written so far."""
        return b"".join(self._parts)

    def raw(self, content: bytes) -> Self:
        """Append bytes as they are; the caller knows their alignment."""
        self._parts.append(content)
        self._offset += len(content)
        return self

    def align(self, alignment: int) -> Self:
        """Append zeros until the next value is aligned."""
        return self.raw(bytes(-self._offset % alignment))

    def uint8(self, *values: int) -> Self:
        """Append numbers of one byte; a bool is one of them."""
        return self.raw(bytes(values))

    def uint32(self, *values: int) -> Self:
        """Append numbers of four bytes."""
        self.align(4)
        for value in values:
            self.raw(_UINT32_STRUCT.pack(value))
        return self

    def string(self, text: str) -> Self:
        """Append a text. A NUL would end it early, so it becomes a replacement character."""
        encoded = text.replace("\0", "\ufffd").encode(errors="replace")
        return self.uint32(len(encoded) + 1).raw(encoded).uint8(0)

    def strings(self, texts: Iterable[str]) -> Self:
        """Append texts one after the other, without their number."""
        for text in texts:
            self.string(text)
        return self


HUMBLE: Final = "humble"
"""The distribution that knows no hashes."""

NO_HASH: Final = "TypeHashNotSupported"
"""What Humble has in place of a hash."""


class RosType(NamedTuple):
    """A message type, such as geometry_msgs/msg/Pose, and the hash of its definition (RIHS01)."""

    name: str
    type_hash: str

    @property
    def dds_name(self) -> str:
        """The name on the wire: geometry_msgs::msg::dds_::Pose_."""
        package, kind, name = self.name.split("/")
        return f"{package}::{kind}::dds_::{name}_"

    def hash_in(self, distribution: str) -> str:
        """Return what a distribution puts in place of the hash."""
        return NO_HASH if distribution == HUMBLE else self.type_hash


POSE_STAMPED: Final = RosType(
    "geometry_msgs/msg/PoseStamped", "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
)
WRENCH_STAMPED: Final = RosType(
    "geometry_msgs/msg/WrenchStamped",
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
)
POINT_STAMPED: Final = RosType(
    "geometry_msgs/msg/PointStamped",
    "RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
)
TF_MESSAGE: Final = RosType(
    "tf2_msgs/msg/TFMessage", "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
)
POINT_CLOUD: Final = RosType(
    "sensor_msgs/msg/PointCloud2", "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
)
FLOAT_ARRAY: Final = RosType(
    "std_msgs/msg/Float32MultiArray",
    "RIHS01_0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0",
)
DIAGNOSTIC_ARRAY: Final = RosType(
    "diagnostic_msgs/msg/DiagnosticArray",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
)

ROS_TYPES: Final = (
    *(POSE_STAMPED, WRENCH_STAMPED, POINT_STAMPED, TF_MESSAGE, POINT_CLOUD, FLOAT_ARRAY, DIAGNOSTIC_ARRAY),
)
"""All of them."""


Array = npt.NDArray[Any]

_STAMP_BYTES: Final = 8
_COUNT_BYTES: Final = 4

pack_pose: Final = struct.Struct("<7d").pack
"""Encodes a geometry_msgs/Pose or Transform: x, y, z in m, and a quaternion x, y, z, w."""

pack_wrench: Final = struct.Struct("<6d").pack
"""Encodes a geometry_msgs/Wrench: force x, y, z in N, and torque x, y, z in Nm."""

pack_point: Final = struct.Struct("<3d").pack
"""Encodes a geometry_msgs/Point: x, y, z in m."""

POINT: Final = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("reliability", "<f4"), ("marker", "<u4")])
"""One point of a cloud: position, the server's reliability, and the marker's index."""

_POINT_DATATYPES: Final = {"f": 7, "u": 6}
"""By the kind of numbers: FLOAT32 and UINT32 of sensor_msgs/PointField."""

MAX_LABEL_BYTES: Final = 16 * 1024
"""Longer labels of channels are left out, because they are in every message."""


def _rows(*parts: bytes | Array) -> list[bytes]:
    """Return messages of equal size from their parts: bytes that all have, and arrays with a row for each."""
    blocks = [
        np.frombuffer(part, np.uint8) if isinstance(part, bytes) else _bytes_of_rows(part) for part in parts
    ]
    num_rows = next(len(block) for block in blocks if block.ndim > 1)
    ends = np.cumsum([block.shape[-1] for block in blocks]).tolist()
    table = np.empty((num_rows, ends[-1]), np.uint8)
    for start, stop, block in zip([0, *ends], ends, blocks, strict=False):
        table[:, start:stop] = block
    return split_rows(table)


def _bytes_of_rows(rows: Array) -> Array:
    """Return the bytes of each row, shape (rows, bytes)."""
    row_bytes = rows.dtype.itemsize * math.prod(rows.shape[1:])
    return np.ascontiguousarray(rows).reshape(-1).view(np.uint8).reshape(len(rows), row_bytes)


def ros_stamps(utimes: Array) -> Array:
    """Return the stamps of times in µs since the Unix epoch, shape (times, 8), uint8; see ``ros_stamp``."""
    seconds, microseconds = np.divmod(utimes, 1_000_000)
    stamps = np.empty(len(utimes), [("sec", "<i4"), ("nanosec", "<u4")])
    stamps["sec"] = np.clip(seconds, -MAX_STAMP_S - 1, MAX_STAMP_S)
    stamps["nanosec"] = 1000 * microseconds
    return _bytes_of_rows(stamps)


class StampedEncoder:
    """Encodes geometry_msgs/PoseStamped, WrenchStamped and PointStamped of one frame."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id = CdrWriter(_STAMP_BYTES).string(frame_id).align(8).content

    def head(self, stamp: bytes) -> bytes:
        """Return what all messages with this stamp begin with; see ``encode``."""
        return ENCAPSULATION + stamp + self._frame_id

    def encode(self, stamp: bytes, content: bytes) -> bytes:
        """Return a message with the result of ``pack_pose``, ``pack_wrench`` or ``pack_point``."""
        return self.head(stamp) + content

    def encode_rows(self, stamps: Array, values: Array) -> list[bytes]:
        """Return a message for each row of ``values``: points (rows, 3), wrenches (…, 6) or poses (…, 7)."""
        return _rows(ENCAPSULATION, stamps, self._frame_id, values.astype("<f8"))


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
    parts = [ENCAPSULATION, _UINT32_STRUCT.pack(len(transforms))]
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
        assert POINT.fields is not None  # noqa: S101 - for mypy: it has names
        self._floats = self._points.view("<f4").reshape(num_markers, len(POINT.fields))  # the same memory
        writer = CdrWriter(_STAMP_BYTES).string(frame_id).uint32(1, num_markers)  # height, width
        writer.uint32(len(POINT.fields))
        for name, (dtype, offset, *_) in POINT.fields.items():
            writer.string(name).uint32(offset).uint8(_POINT_DATATYPES[dtype.kind]).uint32(1)
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
            is_nan = np.isnan(positions)  # ``any`` over the three takes four times as long
            self._floats[is_nan[:, 0] | is_nan[:, 1] | is_nan[:, 2], :3] = np.nan
        self._floats[:, 3] = reliabilities
        return b"".join((ENCAPSULATION, stamp, self._layout, self._points.tobytes(), bytes([is_dense])))

    def encode_rows(self, stamps: Array, positions: Array, reliabilities: Array) -> list[bytes]:
        """Return a message for each row of ``positions``, shape (rows, n, 3); see ``encode``."""
        points = np.tile(self._points, (len(positions), 1))
        floats = points.view("<f4").reshape(*points.shape, self._floats.shape[1])
        with np.errstate(over="ignore"):
            floats[..., :3] = positions
        floats[..., :3][np.isnan(positions).any(axis=2)] = np.nan
        floats[..., 3] = reliabilities
        is_dense = np.isfinite(floats[..., :3]).all(axis=(1, 2))
        return _rows(ENCAPSULATION, stamps, self._layout, points, is_dense[:, None])


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

    def encode_rows(self, values: Array) -> list[bytes]:
        """Return a message for each row of ``values``, shape (rows, num_channels)."""
        return _rows(ENCAPSULATION, self._layout, values.astype("<f4"))


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
