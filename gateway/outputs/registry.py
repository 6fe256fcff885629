"""The registry of outputs. All code that lists outputs reads it.

The outputs of this package are in a table. Other packages add theirs as entry points of GROUP, with the names
of sections of the configuration (docs/how-to/write-an-output.md). This module imports them, so a
command that needs no outputs does not import it.
"""

import re
from importlib.metadata import EntryPoint
from logging import getLogger
from typing import Final

from gateway.config.settings import OutputSettings, Settings, settings_model
from gateway.errors import ConfigError
from gateway.outputs.adapters.foxglove.settings import FOXGLOVE
from gateway.outputs.adapters.lsl.settings import LSL
from gateway.outputs.adapters.ros2.settings import ROS2
from gateway.outputs.adapters.rtc3d.settings import RTC3D
from gateway.outputs.adapters.vrpn.settings import VRPN
from gateway.outputs.contract import Output
from gateway.outputs.kind import OutputKind
from gateway.outputs.lcm.settings import LCM
from gateway.outputs.takes.settings import TAKES
from gateway.outputs.zenoh.settings import ZENOH
from gateway.runtime.entry_points import add_installed

GROUP: Final = "rtc3d_gateway.outputs"
"""The group of entry points in which packages name their OutputKind."""

OUTPUTS: Final[dict[str, OutputKind]] = {
    kind.name: kind for kind in (ZENOH, LCM, TAKES, ROS2, RTC3D, VRPN, LSL, FOXGLOVE)
}

UNUSABLE: Final[dict[str, str]] = {}
"""By name, why the output of another package cannot be used. A section with this name is an error."""

logger = getLogger(__name__)


def settings_type() -> type[Settings]:
    """Return the model of the whole configuration, with a section for every output."""
    unusable = {name: text for name, text in UNUSABLE.items() if _is_free(name)}
    return settings_model({name: kind.settings for name, kind in OUTPUTS.items()}, unusable)


def build_outputs(settings: Settings) -> list[Output]:
    """Return the enabled outputs. Raises ConfigError if an output rejects its settings."""
    for text in UNUSABLE.values():  # the configuration does not name them: that would have been an error
        logger.warning("not in use: %s", text)
    return [OUTPUTS[name].create(section) for name, section in settings.outputs.items() if section.enabled]


def add_installed_outputs() -> None:
    """Add the outputs of other packages to OUTPUTS, and to UNUSABLE those that cannot be used."""
    UNUSABLE.update(add_installed(GROUP, "output", _add))


def _add(entry: EntryPoint) -> None:
    """Add the kind that an entry point names. Raises ConfigError, and whatever its module raises."""
    if not _is_free(entry.name):
        raise ConfigError(
            f"the name {entry.name!r} is taken, or has other characters than a to z, 0 to 9 and _"
        )
    kind = entry.load()
    if not isinstance(kind, OutputKind):
        raise ConfigError(f"{entry.value} is of the type {type(kind).__name__}, not OutputKind")
    if kind.name != entry.name:
        raise ConfigError(f"its entry point is called {entry.name!r}, and its OutputKind {kind.name!r}")
    section = kind.settings()  # raises ValidationError if a key has no default
    if not isinstance(section, OutputSettings):
        raise ConfigError(f"its settings are of the type {type(section).__name__}, not OutputSettings")
    OUTPUTS[entry.name] = kind


def _is_free(name: str) -> bool:
    """Return whether another package's output can have this section of the configuration."""
    is_taken = name in OUTPUTS or name in Settings.model_fields or hasattr(Settings, name)
    return not is_taken and re.fullmatch("[a-z][a-z0-9_]*", name) is not None


add_installed_outputs()
