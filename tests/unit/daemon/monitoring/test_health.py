"""/healthz and the status line for streams and outputs in every state."""

import json
import logging
import time
from typing import Any

import pytest

from gateway.config.settings import MetricsSettings, SourceSettings, StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.server import health_page, status_lines
from gateway.rtc3d.components import ComponentType
from gateway.runtime.losses import Losses
from gateway.session.process_clock import running_clock
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from tests.support.configurations import make_settings
from tests.support.errors import names
from tests.support.memory_output import MemoryOutput

MARKERS, ANALOG, EVENT = ((ComponentType.MARKERS,), (ComponentType.ANALOG,), (ComponentType.EVENT,))
STALL_TIMEOUT_S = 3.0


class Lab:
    """A gateway that is not running; the tests set the states."""

    def __init__(self, *streams: StreamSettings) -> None:
        self.output = MemoryOutput()
        self.output.start()
        source = SourceSettings(
            name="lab", host="192.0.2.20", streams=streams, stall_timeout_s=STALL_TIMEOUT_S
        )
        settings = make_settings(sources=(source,), metrics=MetricsSettings(enabled=False))
        self.gateway = Gateway(settings, [self.output])
        self.statuses = self.gateway.sources[0].statuses

    def health(self) -> tuple[int, dict[str, Any]]:
        """Return the HTTP status and the JSON body."""
        page = health_page(self.gateway)
        assert page.content_type == "application/json"
        return page.status, json.loads(page.body)

    def line(self) -> str:
        """Return the status line of the source."""
        [line, *_] = status_lines(self.gateway)
        return line

    def problem(self) -> str:
        """Return the problem of the only stream, and check that the HTTP status matches it."""
        status, body = self.health()
        [stream] = body["streams"]
        assert (status, body["healthy"]) == ((503, False) if stream["problem"] else (200, True))
        return str(stream["problem"])


def set_state(status: StreamStatus, state: StreamState, age_s: float | None) -> None:
    status.state = state
    status.last_frame_s = None if age_s is None else running_clock().time() - age_s


def lab_with(state: StreamState, age_s: float | None) -> Lab:
    """Return a gateway with one stream, of markers, in this state."""
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], state, age_s)
    return lab


@pytest.mark.parametrize("state", StreamState)
async def test_a_recent_frame_is_healthy_in_every_state_and_others_only_without_a_measurement(
    state: StreamState,
) -> None:
    """The page turns unhealthy when the gateway gives up the stream, not later."""
    lab = lab_with(state, STALL_TIMEOUT_S - 1)
    assert lab.problem() == ""
    for age_s, values in (
        (STALL_TIMEOUT_S, ["no frame"]),
        (None, ["no frame"]),
        (41.5, ["no frame", "41.5 s"]),
    ):
        set_state(lab.statuses[0], state, age_s)
        is_problem = state is not StreamState.NO_MEASUREMENT
        assert names(lab.problem(), *values) if is_problem else lab.problem() == ""


async def test_a_stop_of_this_process_does_not_make_frames_older() -> None:
    lab = lab_with(StreamState.STREAMING, STALL_TIMEOUT_S - 0.5)
    time.sleep(0.8)  # noqa: ASYNC251 - the process stands still
    assert lab.problem() == ""


async def test_the_problem_names_the_reason_and_what_to_check() -> None:
    lab = lab_with(StreamState.CONNECTING, None)
    assert names(lab.problem(), "no frame", "192.0.2.20:3020")
    set_state(lab.statuses[0], StreamState.WAITING, 41.5)
    lab.statuses[0].record_error("refused by the test")
    assert names(lab.problem(), "41.5 s", "3 s", "refused by the test")
    lab.statuses[0].state = StreamState.IDLE  # the last error is out of date in this state
    assert names(lab.problem(), "41.5 s", "3 s", "192.0.2.20")
    assert "refused" not in lab.problem()


async def test_only_an_idle_on_demand_stream_without_subscribers_needs_no_frames() -> None:
    for on_demand in (True, False):
        lab = Lab(StreamSettings(components=MARKERS, on_demand=on_demand))
        set_state(lab.statuses[0], StreamState.IDLE, None)
        assert lab.problem() != ""
        lab.output.has_subscriber = False
        assert (lab.problem() == "") == on_demand
        lab.statuses[0].state = StreamState.WAITING
        assert lab.problem() != ""


async def test_a_stream_of_events_needs_no_recent_frame() -> None:
    lab = Lab(StreamSettings(components=EVENT))
    for state in (StreamState.IDLE, StreamState.STREAMING):
        set_state(lab.statuses[0], state, None)
        assert lab.problem() == ""
    set_state(lab.statuses[0], StreamState.WAITING, None)
    assert lab.problem() != ""


async def test_one_unhealthy_stream_makes_the_gateway_unhealthy() -> None:
    lab = Lab(StreamSettings(components=MARKERS), StreamSettings(components=ANALOG))
    set_state(lab.statuses[0], StreamState.STREAMING, 0.01)
    set_state(lab.statuses[1], StreamState.STALLED, 41.5)
    status, body = lab.health()
    assert status == 503
    good, bad = body["streams"]
    assert (good["source"], good["stream"], good["state"], good["problem"]) == ("lab", "3d", "streaming", "")
    assert (bad["source"], bad["stream"], bad["state"]) == ("lab", "analog", "stalled")
    assert bad["problem"]
    assert bad["last_frame_age_s"] >= 41.5


async def test_an_output_that_cannot_send_is_listed_with_its_problem() -> None:
    lab = lab_with(StreamState.STREAMING, 0.01)
    assert lab.health()[0] == 200
    lab.output.close()
    status, body = lab.health()
    assert status == 503
    assert body["healthy"] is False
    assert body["outputs"] == [{"output": "memory", "problem": lab.output.health().problem}]


async def test_loss_in_the_last_minute_degrades_the_gateway_which_is_still_200() -> None:
    lab = lab_with(StreamState.STREAMING, 0.01)
    status, body = lab.health()
    assert (status, body["status"], body["reasons"], body["losses"]) == (200, "healthy", [], [])
    for _ in range(436):
        lab.statuses[0].frame_skipped(2)
    lab.output.close()
    lab.gateway.sources[0].fan_out.publish_status(b"status")
    lab.output.start()
    status, body = lab.health()
    assert (status, body["status"], body["healthy"]) == (200, "degraded", True)
    of_stream, of_output = body["reasons"]
    assert names(of_stream, "lab (3d)", "872 messages", "436 frames", "skipped while behind")
    assert names(of_output, "lab to memory", "1 message", "not open")
    skipped, unsent = body["losses"]
    assert skipped.pop("age_s") >= 0
    assert names(skipped.pop("text"), "backlog: latest")
    expected: dict[str, Any] = {
        "source": "lab",
        "stream": "3d",
        "output": None,
        "cause": "skipped while behind",
    }
    expected |= {"messages": 872, "frames": 436, "messages_last_minute": 872, "frames_last_minute": 436}
    assert skipped == expected
    expected = {"source": "lab", "stream": None, "output": "memory", "cause": "not open"}
    assert unsent.items() >= (expected | {"messages": 1, "frames": 0}).items()


@pytest.mark.parametrize(
    ("lag_s", "age_s", "expected"),
    [(30.0, 0.01, "degraded"), (1.0, 0.01, "degraded"), (0.9, 0.01, "healthy"), (30.0, 60.0, "unhealthy")],
)
async def test_late_frames_degrade_the_gateway(lag_s: float, age_s: float, expected: str) -> None:
    """After a stop of 30 s, the gateway was healthy while all frames were from the past."""
    lab = lab_with(StreamState.STREAMING, age_s)
    lab.statuses[0].lag_s = lag_s
    status, body = lab.health()
    assert (status, body["status"]) == (503 if expected == "unhealthy" else 200, expected)
    assert len(body["reasons"]) == (expected != "healthy")
    assert body["streams"][0]["lag_s"] == lag_s


async def test_a_warning_of_an_output_degrades_the_gateway(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that another gateway publishes a source of the same name."""
    lab = lab_with(StreamState.STREAMING, 0.01)
    monkeypatch.setattr(lab.output, "warnings", lambda: ["lab: another gateway"])
    status, body = lab.health()
    assert (status, body["status"], body["reasons"]) == (200, "degraded", ["lab: another gateway"])
    assert "lab: another gateway" in status_lines(lab.gateway)


async def test_older_loss_is_in_the_totals_but_does_not_degrade() -> None:
    lab = lab_with(StreamState.STREAMING, 0.01)
    now_s = 1000.0
    lab.statuses[0].losses = Losses(logging.getLogger("tests"), "lab", lambda: now_s)
    lab.statuses[0].frame_skipped(1)
    now_s += 61
    status, body = lab.health()
    assert (status, body["status"], body["reasons"]) == (200, "healthy", [])
    [loss] = body["losses"]
    assert (loss["frames"], loss["frames_last_minute"], loss["age_s"]) == (1, 0, 61.0)


async def test_a_problem_is_unhealthy_even_if_something_is_lost_and_comes_first() -> None:
    lab = lab_with(StreamState.WAITING, None)
    lab.statuses[0].frame_skipped(1)
    status, body = lab.health()
    assert (status, body["status"], body["healthy"]) == (503, "unhealthy", False)
    assert [reason.partition(": ")[2][:8] for reason in body["reasons"]] == ["no frame", "lost in "]


@pytest.mark.parametrize("age_s", [None, STALL_TIMEOUT_S + 1])
async def test_frames_that_are_all_rejected_are_named(age_s: float | None) -> None:
    lab = lab_with(StreamState.IDLE, age_s)
    lab.statuses[0].frame_rejected("too short", 1)
    assert names(lab.problem(), "all", "rejected", "too short")
    assert names(lab.line(), "lab", lab.problem(), "1 message", "1 frame")


async def test_a_frame_that_is_rejected_among_others_is_only_loss() -> None:
    lab = lab_with(StreamState.STREAMING, 0.01)
    lab.statuses[0].frame_rejected("too short", 1)
    assert lab.problem() == ""
    assert names(lab.line(), "lab: streaming 0.0 Hz", "1 message", "1 frame", "frame rejected")


@pytest.mark.parametrize(
    ("since_s", "is_problem"), [(STALL_TIMEOUT_S - 1, False), (STALL_TIMEOUT_S + 1, True)]
)
async def test_frames_without_a_component_of_the_stream_are_named(since_s: float, is_problem: bool) -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    [status] = lab.statuses
    set_state(status, StreamState.STREAMING, since_s)
    status.components_received("6d analog")
    set_state(status, StreamState.STREAMING, 0.01)
    status.components_received("6d analog")
    problem = lab.problem()
    assert names(problem, "3d", "6d analog", "sources.streams") if is_problem else problem == ""
    assert lab.line() == f"lab: {problem or 'streaming 0.0 Hz'}"
    status.components_received("")
    assert lab.problem() == ""


async def test_a_stream_of_events_needs_none_in_its_frames() -> None:
    lab = Lab(StreamSettings(components=EVENT))
    set_state(lab.statuses[0], StreamState.STREAMING, 41.5)
    lab.statuses[0].components_received("3d")
    set_state(lab.statuses[0], StreamState.STREAMING, 0.01)
    assert lab.problem() == ""
    assert lab.line() == "lab: streaming 0.0 Hz"


# --- the status line


async def test_streams_in_different_states_are_listed_by_components() -> None:
    lab = Lab(StreamSettings(components=MARKERS), StreamSettings(components=ANALOG))
    assert names(lab.line(), "lab", "192.0.2.20:3020")
    lab.statuses[0].state = StreamState.STREAMING
    first, second = lab.line().split(", ")
    assert names(first, "lab: 3d", "0.0 Hz")
    assert names(second, "analog", "192.0.2.20:3020")


async def test_only_outputs_that_cannot_send_or_lose_something_have_a_line() -> None:
    lab = lab_with(StreamState.STREAMING, 0.01)
    assert status_lines(lab.gateway) == ["lab: streaming 0.0 Hz"]
    lab.output.close()
    lab.gateway.sources[0].fan_out.publish_status(b"status")
    _, of_output, lost = status_lines(lab.gateway)
    assert of_output == f"memory: {lab.output.health().problem}"
    assert names(lost, "lab to memory", "1 message", "not open")
