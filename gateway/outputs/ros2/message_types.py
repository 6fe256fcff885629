"""The types of the ROS 2 messages that the gateway publishes, with the hashes of their definitions.

A test compares the hashes with those that rosbags computes from the definitions (REP 2011). They are the same
in all distributions since Iron.
"""

from typing import Final, NamedTuple

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
    "geometry_msgs/msg/PoseStamped",
    "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
)
WRENCH_STAMPED: Final = RosType(
    "geometry_msgs/msg/WrenchStamped",
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
)
TF_MESSAGE: Final = RosType(
    "tf2_msgs/msg/TFMessage",
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
)
POINT_CLOUD: Final = RosType(
    "sensor_msgs/msg/PointCloud2",
    "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
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
    POSE_STAMPED,
    WRENCH_STAMPED,
    TF_MESSAGE,
    POINT_CLOUD,
    FLOAT_ARRAY,
    DIAGNOSTIC_ARRAY,
)
"""All of them."""
