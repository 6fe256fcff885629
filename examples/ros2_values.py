"""Functions that convert the gateway's messages into values for ROS 2 messages. They do not need ROS.

examples/ros2_bridge.py uses them. ROS uses metres, quaternions in the order x, y, z, w, and stamps in
seconds and nanoseconds.
"""

import struct
from typing import Final, NamedTuple

import numpy as np

_POSE: Final = struct.Struct(">8sqqqiiiq?3f4ff")  # tool_pose_t, 85 bytes
_MARKERS: Final = struct.Struct(">8sqqqiiiqi")  # markers_t without its items
_FLOAT: Final = np.dtype(">f4")
_MM_PER_M: Final = 1000


class Stamp(NamedTuple):
    """A time since the Unix epoch, in the form of builtin_interfaces/Time."""

    sec: int
    nanosec: int

    @classmethod
    def of(cls, utime: int) -> "Stamp":
        """Return the stamp for ``utime``, which is in µs."""
        seconds, microseconds = divmod(utime, 1_000_000)
        return cls(seconds, 1000 * microseconds)


class Pose(NamedTuple):
    """The values of a geometry_msgs/PoseStamped, without its frame."""

    stamp: Stamp
    position_m: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]


class Cloud(NamedTuple):
    """The values of a sensor_msgs/PointCloud2: x, y, z of each point as little-endian float32."""

    stamp: Stamp
    width: int
    data: bytes


def pose(message: bytes) -> Pose | None:
    """Return the pose in a ``tool_pose_t``, or None if the tool is out of view: ROS has no NaN poses."""
    _, _, capture_utime, _, _, _, _, _, visible, x, y, z, qx, qy, qz, qw, _ = _POSE.unpack(message)
    return Pose(Stamp.of(capture_utime), (x, y, z), (qx, qy, qz, qw)) if visible else None


def cloud(message: bytes) -> Cloud:
    """Return the markers of a ``markers_t`` in mm as points in m. A missing marker becomes a NaN point."""
    _, _, capture_utime, _, _, _, _, _, count = _MARKERS.unpack_from(message)
    markers = np.frombuffer(message, _FLOAT, 4 * count, _MARKERS.size).reshape(-1, 4)
    points_m = (markers[:, :3] / _MM_PER_M).astype("<f4")
    return Cloud(Stamp.of(capture_utime), count, points_m.tobytes())
