"""The registry of outputs. All code that lists outputs reads it. To add an output, add it to OUTPUTS."""

from typing import Final

from gateway.config.settings import Settings, settings_model
from gateway.outputs.contract import Output
from gateway.outputs.foxglove.kind import FOXGLOVE
from gateway.outputs.kind import OutputKind
from gateway.outputs.lcm.kind import LCM
from gateway.outputs.lsl.kind import LSL
from gateway.outputs.ros2.kind import ROS2
from gateway.outputs.rtc3d.kind import RTC3D
from gateway.outputs.takes.kind import TAKES
from gateway.outputs.vrpn.kind import VRPN
from gateway.outputs.zenoh.kind import ZENOH

OUTPUTS: Final[dict[str, OutputKind]] = {
    kind.name: kind for kind in (ZENOH, LCM, TAKES, ROS2, RTC3D, VRPN, LSL, FOXGLOVE)
}


def settings_type() -> type[Settings]:
    """Return the model of the whole configuration, with a section for every output."""
    return settings_model({name: kind.settings for name, kind in OUTPUTS.items()})


def build_outputs(settings: Settings) -> list[Output]:
    """Return the enabled outputs. Raises ConfigError if an output rejects its settings."""
    return [OUTPUTS[name].create(section) for name, section in settings.outputs.items() if section.enabled]
