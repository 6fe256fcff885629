"""The registry: which sections the configuration has, and which outputs it builds."""

from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.adapters.rtc3d.settings import Rtc3dSettings
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.registry import OUTPUTS, build_outputs
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.components import ComponentType
from tests.support.configurations import make_settings

GROUP = "udpm://239.255.76.67:7667"
SOURCES = (SourceSettings(name="lab", host="127.0.0.1"),)


def test_every_output_has_its_section() -> None:
    settings = make_settings(sources=SOURCES)
    assert {name: type(section) for name, section in settings.outputs.items()} == {
        "zenoh": ZenohSettings,
        "lcm": LcmSettings,
        "takes": TakesSettings,
        "ros2": Ros2Settings,
        "rtc3d": Rtc3dSettings,
        "vrpn": VrpnSettings,
        "lsl": LslSettings,
        "foxglove": FoxgloveSettings,
    }
    assert list(OUTPUTS) == list(settings.outputs)


def test_only_enabled_outputs_are_built_with_their_settings() -> None:
    zenoh, lcm = ZenohSettings(prefix="hall"), LcmSettings(url="memq://", prefix="HALL")
    first, second = build_outputs(make_settings(sources=SOURCES, zenoh=zenoh, lcm=lcm))
    assert isinstance(first, ZenohOutput)
    assert isinstance(second, LcmOutput)
    assert (first.settings, second.settings) == (zenoh, lcm)
    disabled = zenoh.model_copy(update={"enabled": False})
    [only] = build_outputs(make_settings(sources=SOURCES, zenoh=disabled, lcm=lcm))
    assert isinstance(only, LcmOutput)


def test_outputs_have_the_limits_and_the_tool_poses_of_their_settings() -> None:
    rates = {ComponentType.ANALOG: 50.0}
    for has_tool_poses in (True, False):
        zenoh = ZenohOutput(ZenohSettings(max_rate_hz=rates, tool_poses=has_tool_poses))
        lcm = LcmOutput(LcmSettings(max_rate_hz=rates, tool_poses=has_tool_poses))
        assert [zenoh.max_rate_hz, lcm.max_rate_hz] == [rates, rates]
        assert [zenoh.has_tool_poses, lcm.has_tool_poses] == [has_tool_poses, has_tool_poses]


@pytest.mark.parametrize(
    ("output", "settings", "leaves"),
    [
        ("zenoh", ZenohSettings(), True),
        ("zenoh", ZenohSettings(config={"scouting": {"multicast": {"enabled": False}}}), True),  # listens
        ("lcm", LcmSettings(url=f"{GROUP}?ttl=0"), False),
        ("lcm", LcmSettings(url=f"{GROUP}?ttl=1"), True),
        ("lcm", LcmSettings(url=GROUP), False),
        ("lcm", LcmSettings(url="memq://"), False),
        ("lcm", LcmSettings(url="tcpq://127.0.0.1:7700"), False),
        ("lcm", LcmSettings(url="tcpq://192.0.2.10:7700"), True),
    ],
)
def test_whether_an_output_leaves_this_computer(output: str, settings: Any, leaves: bool) -> None:
    assert OUTPUTS[output].leaves_host(settings) is leaves
