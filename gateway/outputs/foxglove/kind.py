"""The output for Foxglove, Lichtblick and PlotJuggler in the registry."""

from typing import Final

from gateway.outputs.contract import Output
from gateway.outputs.foxglove.checks import CHECKS, check_foxglove, leaves_host
from gateway.outputs.foxglove.settings import FoxgloveSettings
from gateway.outputs.kind import OutputKind, missing_package


def _create(settings: FoxgloveSettings) -> Output:
    """Return the output. Raises ConfigError if its packages are not installed."""
    try:
        from gateway.outputs.foxglove.output import FoxgloveOutput  # noqa: PLC0415 - needs the extra foxglove
    except ImportError as error:
        raise missing_package("foxglove", "foxglove", error) from error
    return FoxgloveOutput(settings)


FOXGLOVE: Final = OutputKind(
    name="foxglove",
    settings=FoxgloveSettings,
    create=_create,
    checks=CHECKS,
    run_checks=check_foxglove,
    leaves_host=leaves_host,
)
