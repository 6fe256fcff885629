"""The log, word for word, when an output does not accept messages or tool poses cannot be published."""

import logging
from types import SimpleNamespace

import pytest

from gateway.errors import OutputError
from gateway.messages.stamp import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER
from gateway.rtc3d.parameters import Parameters, Parameters3D
from tests.server_parameters import in_metres
from tests.toy_output import ToyOutput
from tests.unit.publish.test_tool_poses import publish_tools

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
ALL = frozenset(WIRE_ORDER)


def logged(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [f"{record.levelname} {record.getMessage()}" for record in caplog.records]


def set_unit(fan_out: FanOut, unit: str) -> None:
    fan_out.set_parameters(in_metres(Parameters(markers=Parameters3D(unit=unit))))


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (OutputError("no router is connected", cause="no router"), "no router is connected"),
        (ValueError("a defect"), "ValueError: a defect"),
    ],
)
def test_a_message_that_an_output_does_not_accept_is_logged(
    error: Exception, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    output = ToyOutput("zenoh")
    output.error = error
    FanOut("lab", [output]).publish_status(b"status")
    assert logged(caplog) == [f"WARNING lab to zenoh: {text}"]


@pytest.mark.interpreted
def test_an_output_that_has_just_been_added_may_take_a_moment_to_open(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr("gateway.publish.routes.time", SimpleNamespace(monotonic=lambda: clock.now_s))
    output = ToyOutput("lcm")
    output.error = OutputError("LCM is not open", cause="not open")
    fan_out = FanOut("lab", [output])
    for clock.now_s in (101.9, 101.9, 102.1, 102.2):
        fan_out.publish_status(b"status")
    assert logged(caplog) == ["INFO lab to lcm: LCM is not open", "WARNING lab to lcm: LCM is not open"]


def test_too_many_tools_are_logged_with_what_is_lost(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    fan_out = FanOut("lab", [ToyOutput(has_tool_poses=True)])
    publish_tools(fan_out, 257)
    publish_tools(fan_out, 3)
    fan_out.close()
    assert logged(caplog) == [
        "WARNING lab to toy: a frame of 257 tools, more than 256: no tool poses are published",
        "INFO lab to toy: lost within 0.0 s: 257 messages of 1 frame (too many tools)",
    ]


def test_an_unknown_unit_is_logged_with_what_is_lost(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    fan_out = FanOut("lab", [ToyOutput(has_tool_poses=True)])
    set_unit(fan_out, "x" * 41)
    publish_tools(fan_out, 2)
    publish_tools(fan_out, 0)
    set_unit(fan_out, "m")
    publish_tools(fan_out, 2)
    fan_out.close()
    assert logged(caplog) == [
        f"WARNING lab to toy: unit of length '{'x' * 40}' is unknown: no tool poses are published; "
        "set it to mm or m in the server, or set transform.units of the source in the configuration",
        "INFO lab to toy: lost within 0.0 s: 2 messages of 1 frame (unknown unit)",
    ]


def test_parameters_without_markers_are_in_millimetres(caplog: pytest.LogCaptureFixture) -> None:
    fan_out = FanOut("lab", [ToyOutput(has_tool_poses=True)])
    fan_out.set_parameters(in_metres(Parameters()))
    assert not caplog.records
