"""/healthz for streams and outputs in every state."""

import json
from typing import Any

import pytest

from gateway.config.settings import MetricsSettings, SourceSettings, StreamSettings
from gateway.gateway import Gateway
from gateway.monitoring.health import health_page
from gateway.outputs.memory import MemoryOutput
from gateway.rtc3d.components import ComponentType
from gateway.stream.running_time import running_clock
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from tests.configurations import make_settings

MARKERS, ANALOG, EVENT = (
    (ComponentType.MARKERS,),
    (ComponentType.ANALOG,),
    (ComponentType.EVENT,),
)
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

    def problem(self) -> str:
        """Return the problem of the only stream, and check that the HTTP status matches it."""
        status, body = self.health()
        [stream] = body["streams"]
        assert (status, body["healthy"]) == ((503, False) if stream["problem"] else (200, True))
        return str(stream["problem"])


def set_state(status: StreamStatus, state: StreamState, age_s: float | None) -> None:
    status.state = state
    status.last_frame_s = None if age_s is None else running_clock().time() - age_s


@pytest.mark.parametrize("state", StreamState)
async def test_a_recent_frame_is_healthy_in_every_state(state: StreamState) -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], state, STALL_TIMEOUT_S - 1)
    assert lab.problem() == ""


@pytest.mark.parametrize("state", [state for state in StreamState if state is not StreamState.NO_MEASUREMENT])
@pytest.mark.parametrize(("age_s", "text"), [(None, "no frame so far"), (41.5, "no frame for 41.5 s")])
async def test_a_stream_without_a_recent_frame_is_unhealthy(
    state: StreamState, age_s: float | None, text: str
) -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], state, age_s)
    assert lab.problem().startswith(text)


@pytest.mark.parametrize("age_s", [None, 41.5])
async def test_no_measurement_is_healthy(age_s: float | None) -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], StreamState.NO_MEASUREMENT, age_s)
    assert lab.problem() == ""


async def test_the_problem_names_the_reason_and_what_to_check() -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], StreamState.CONNECTING, None)
    assert lab.problem() == "no frame so far: connecting to 192.0.2.20:3020"
    set_state(lab.statuses[0], StreamState.WAITING, 41.5)
    lab.statuses[0].record_error("connection refused by 192.0.2.20:3020; is the RT server running?")
    assert lab.problem() == (
        "no frame for 41.5 s (limit 3 s): connection refused by 192.0.2.20:3020; is the RT server running?"
    )
    lab.statuses[0].state = StreamState.IDLE  # the last error is out of date in this state
    assert "is a measurement running?" in lab.problem()


async def test_an_on_demand_stream_without_subscribers_is_healthy() -> None:
    lab = Lab(StreamSettings(components=MARKERS, on_demand=True))
    set_state(lab.statuses[0], StreamState.IDLE, None)
    assert lab.problem() != ""
    lab.output.has_subscriber = False
    assert lab.problem() == ""
    lab.statuses[0].state = StreamState.WAITING
    assert lab.problem() != ""


async def test_other_streams_without_subscribers_still_need_frames() -> None:
    lab = Lab(StreamSettings(components=MARKERS))
    lab.output.has_subscriber = False
    set_state(lab.statuses[0], StreamState.IDLE, None)
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
    lab = Lab(StreamSettings(components=MARKERS))
    set_state(lab.statuses[0], StreamState.STREAMING, 0.01)
    assert lab.health()[0] == 200
    lab.output.close()
    status, body = lab.health()
    assert status == 503
    assert body["healthy"] is False
    assert body["outputs"] == [{"output": "memory", "problem": lab.output.health().problem}]
