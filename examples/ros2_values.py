"""What ROS 2 messages hold, from the gateway's messages, without ROS. examples/ros2_bridge.py fills them in.

ROS counts in metres, with quaternions x, y, z, w and stamps in seconds and nanoseconds.
"""

import struct
from typing import Final, NamedTuple

import numpy as np

_POSE: Final = struct.Struct(">8sqqqiiq?3f4ff")  # tool_pose_t, 81 bytes
_MARKERS: Final = struct.Struct(">8sqqqiiqi")  # markers_t, up to its items
_MARKER: Final = np.dtype(">f4")
_MM_PER_M: Final = 1000


class Stamp(NamedTuple):
    """A time since the Unix epoch, as builtin_interfaces/Time has it."""

    sec: int
    nanosec: int

    @classmethod
    def of(cls, utime: int) -> "Stamp":
        """Return the stamp of ``utime``, in µs."""
        seconds, microseconds = divmod(utime, 1_000_000)
        return cls(seconds, 1000 * microseconds)


class Pose(NamedTuple):
    """What geometry_msgs/PoseStamped holds, without its frame."""

    stamp: Stamp
    position_m: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]


class Cloud(NamedTuple):
    """What sensor_msgs/PointCloud2 holds: x, y, z of each point as float32, little-endian."""

    stamp: Stamp
    width: int
    data: bytes


def pose(message: bytes) -> Pose | None:
    """Return the pose in a ``tool_pose_t``; None while the tool is out of view, for ROS has no NaN poses."""
    _, _, capture_utime, _, _, _, _, visible, x, y, z, qx, qy, qz, qw, _ = _POSE.unpack(message)
    return Pose(Stamp.of(capture_utime), (x, y, z), (qx, qy, qz, qw)) if visible else None


def cloud(message: bytes) -> Cloud:
    """Return the markers of a ``markers_t`` in mm as points in m; a missing one stays, as NaN."""
    _, _, capture_utime, _, _, _, _, count = _MARKERS.unpack_from(message)
    markers = np.frombuffer(message, _MARKER, 4 * count, _MARKERS.size).reshape(-1, 4)
    points_m = (markers[:, :3] / _MM_PER_M).astype("<f4")
    return Cloud(Stamp.of(capture_utime), count, points_m.tobytes())
