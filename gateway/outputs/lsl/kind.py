"""The output for LSL in the registry."""

from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.lsl.checks import CHECKS, check_lsl
from gateway.outputs.lsl.output import LslOutput
from gateway.outputs.lsl.settings import LslSettings

LSL: Final = OutputKind(
    name=LslOutput.name,
    settings=LslSettings,
    create=LslOutput,
    checks=CHECKS,
    run_checks=check_lsl,
)
"""The section ``lsl`` of the configuration. Its ports are open on every network interface."""
