"""The output takes in the registry."""

from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.takes.checks import CHECKS, check_takes
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings

TAKES: Final = OutputKind(
    name=TakesOutput.name,
    settings=TakesSettings,
    create=TakesOutput,
    checks=CHECKS,
    run_checks=check_takes,
    commands=("take",),
    leaves_host=lambda _settings: False,
)
