"""The output for ROS 2 in the registry."""

from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.ros2.checks import CHECKS, check_ros2, leaves_host
from gateway.outputs.ros2.output import Ros2Output
from gateway.outputs.ros2.settings import Ros2Settings

ROS2: Final = OutputKind(
    name=Ros2Output.name,
    settings=Ros2Settings,
    create=Ros2Output,
    checks=CHECKS,
    run_checks=check_ros2,
    leaves_host=leaves_host,
)
