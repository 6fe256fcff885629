"""The output rtc3d in the registry."""

import ipaddress
from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.rtc3d.checks import CHECKS, check_rtc3d
from gateway.outputs.rtc3d.output import Rtc3dOutput
from gateway.outputs.rtc3d.settings import Rtc3dSettings


def _leaves_host(settings: Rtc3dSettings) -> bool:
    if settings.host == "localhost":
        return False
    try:
        return not ipaddress.ip_address(settings.host).is_loopback
    except ValueError:
        return True


RTC3D: Final = OutputKind(
    name=Rtc3dOutput.name,
    settings=Rtc3dSettings,
    create=Rtc3dOutput,
    checks=CHECKS,
    run_checks=check_rtc3d,
    leaves_host=_leaves_host,
)
