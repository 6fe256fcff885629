"""The output vrpn in the registry."""

from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.vrpn.checks import CHECKS, check_vrpn, leaves_host
from gateway.outputs.vrpn.output import VrpnOutput
from gateway.outputs.vrpn.settings import VrpnSettings

VRPN: Final = OutputKind(
    name=VrpnOutput.name,
    settings=VrpnSettings,
    create=VrpnOutput,
    checks=CHECKS,
    run_checks=check_vrpn,
    leaves_host=leaves_host,
)
