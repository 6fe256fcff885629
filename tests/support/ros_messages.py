"""Messages of ROS 2 as the rosbags package reads and writes them, independently of the gateway."""

from typing import Any, Final

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

JAZZY: Final[Typestore] = get_typestore(Stores.ROS2_JAZZY)


def message(type_name: str, **fields: Any) -> Any:
    """Return a message of a type such as "geometry_msgs/msg/Pose"."""
    return JAZZY.types[type_name](**fields)


def header(utime: int, frame_id: str) -> Any:
    """Return a std_msgs/Header for a time in µs."""
    sec, microseconds = divmod(utime, 1_000_000)
    time = message("builtin_interfaces/msg/Time", sec=sec, nanosec=1000 * microseconds)
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame_id)


def tf_message(utime: int, frame_id: str, children: list[tuple[str, tuple[float, ...]]]) -> Any:
    """Return a TFMessage with the name and the pose of each child."""
    transforms = []
    for child, (x, y, z, qx, qy, qz, qw) in children:
        translation = message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        rotation = message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
        transform = message("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        transforms.append(
            message(
                "geometry_msgs/msg/TransformStamped",
                header=header(utime, frame_id),
                child_frame_id=child,
                transform=transform,
            )
        )
    return message("tf2_msgs/msg/TFMessage", transforms=transforms)


def wrench_stamped(utime: int, frame_id: str, values: tuple[float, ...]) -> Any:
    """Return a WrenchStamped of force and torque."""
    force, torque = (
        message("geometry_msgs/msg/Vector3", x=x, y=y, z=z) for x, y, z in (values[:3], values[3:])
    )
    wrench = message("geometry_msgs/msg/Wrench", force=force, torque=torque)
    return message("geometry_msgs/msg/WrenchStamped", header=header(utime, frame_id), wrench=wrench)


def encoded(value: Any) -> bytes:
    """Return the CDR of a message."""
    return bytes(JAZZY.serialize_cdr(value, value.__msgtype__))


def decoded(cdr: bytes, type_name: str) -> Any:
    """Return the message in some CDR."""
    return JAZZY.deserialize_cdr(cdr, type_name)
