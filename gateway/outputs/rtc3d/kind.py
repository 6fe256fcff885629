"""The output rtc3d in the registry."""

from typing import Final

from gateway.outputs.kind import OutputKind
from gateway.outputs.listen_address import is_loopback
from gateway.outputs.rtc3d.checks import CHECKS, check_rtc3d
from gateway.outputs.rtc3d.output import Rtc3dOutput
from gateway.outputs.rtc3d.settings import Rtc3dSettings

RTC3D: Final = OutputKind(
    name=Rtc3dOutput.name,
    settings=Rtc3dSettings,
    create=Rtc3dOutput,
    checks=CHECKS,
    run_checks=check_rtc3d,
    leaves_host=lambda settings: not is_loopback(settings.host),
)
