"""Changes to a stream by demand and by lateness, with a scripted server."""

import asyncio
import gc
import logging
import re
from typing import Any

import pytest

from gateway.errors import DefectError, RequestError
from gateway.rtc3d.components import ComponentType
from gateway.session.state import StreamState
from gateway.session.stream_requests import DEMAND_POLL_S, MAX_RESUMES
from tests.support.clocks import settle
from tests.support.errors import names, raises
from tests.unit.session.scripted_server import obliging, refusing, silent_to
from tests.unit.session.session_lab import Lab

START, STOP = "StreamFrames AllFrames", "StreamFrames Stop"
HALF = "StreamFrames FrequencyDivisor:2"


async def started(**settings: Any) -> Lab:
    """Return the lab of a stream after its handshake."""
    lab = Lab(components=("all",), **settings)
    await lab.start()
    lab.changes.start()
    return lab


async def stopped(**settings: Any) -> Lab:
    """Return the lab of a stream that was stopped since it has no subscribers."""
    lab = await started(on_demand=True, idle_after_s=5.0, **settings)
    lab.has_subscribers = False
    await asyncio.sleep(6)
    return lab


def requests(lab: Lab) -> list[str]:
    """Return the commands since the handshake."""
    return lab.commands[3:]


async def change(lab: Lab, halvings: int, lag_s: float | None = None) -> None:
    if lag_s is not None:
        lab.status.lag_s = lag_s
    lab.changes.lateness_changed(halvings)
    await settle()


def records(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    """Return the records about demand and lateness."""
    return [record for record in caplog.records if re.search("subscriber|late|in time", record.getMessage())]


async def test_an_on_demand_stream_stops_once_without_subscribers_and_resumes_with_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "gateway.session")
    lab = await started(on_demand=True, idle_after_s=5.0)
    await asyncio.sleep(60)
    lab.has_subscribers = False
    await asyncio.sleep(4.9)
    assert requests(lab) == []
    await asyncio.sleep(0.1 + DEMAND_POLL_S)
    await settle()
    assert (requests(lab), lab.status.rate) == ([STOP], "")
    await asyncio.sleep(60)
    lab.has_subscribers = True
    await asyncio.sleep(DEMAND_POLL_S)
    await settle()
    assert (requests(lab), lab.status.rate) == ([STOP, START], "AllFrames")
    await asyncio.sleep(60)
    lab.has_subscribers = False
    await asyncio.sleep(60)
    assert requests(lab) == [STOP, START, STOP]
    messages = [record.getMessage() for record in records(caplog)]
    said = [names(each, "lab (3d)", "stopped") for each in messages]
    assert said == [True, False, True]


async def test_a_short_absence_of_subscribers_does_not_stop_an_on_demand_stream() -> None:
    lab = await started(on_demand=True, idle_after_s=5.0)
    for _ in range(5):
        lab.has_subscribers = not lab.has_subscribers
        await asyncio.sleep(4)
    assert requests(lab) == []


async def test_other_streams_run_without_subscribers() -> None:
    lab = await started(idle_after_s=5.0)
    lab.has_subscribers = False
    await asyncio.sleep(60)
    assert requests(lab) == []


async def test_lateness_is_a_warning_once_and_its_end_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session")
    lab = await started(adapt_rate=True)
    for halvings, lag_s in ((1, 0.3), (2, 0.3), (1, 0.0), (0, 0.0)):
        await change(lab, halvings, lag_s)
    assert requests(lab) == [HALF, "StreamFrames FrequencyDivisor:4", HALF, START]
    assert lab.status.rate == "AllFrames"
    assert [record.levelname for record in records(caplog)] == ["WARNING", "DEBUG", "DEBUG", "INFO"]
    first, second, third, last = [record.getMessage() for record in records(caplog)]
    assert names(first, "lab (3d)", "300 ms late", "FrequencyDivisor:2")
    assert names(second, "lab (3d)", "FrequencyDivisor:4", "failure 2")
    assert names(third, "lab (3d)", "in time", "FrequencyDivisor:2")
    assert names(last, "lab (3d)", "in time", "AllFrames")


async def test_a_reduced_rate_is_requested_again_with_other_components() -> None:
    """The request for components has no rate; without another one, the full rate would reach a slow link."""
    lab = await started(adapt_rate=True)
    await change(lab, 1)
    lab.changes.request_components((ComponentType.MARKERS,))
    await settle()
    assert requests(lab) == [HALF, "StreamFrames AllFrames 3D", f"{HALF} 3D"]
    lab.changes.lateness_changed(0)
    is_full = [lab.changes.is_full_rate]  # the server does not know yet
    await settle()
    assert [*is_full, lab.changes.is_full_rate] == [False, True]


async def test_by_default_the_server_is_asked_for_nothing(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session")
    lab = await started()
    lab.status.lag_s = 0.3
    for halvings in (1, 0):
        await change(lab, halvings)
    assert requests(lab) == []
    assert [record.levelname for record in records(caplog)] == ["WARNING", "INFO"]
    late, in_time = [record.getMessage() for record in records(caplog)]
    assert names(late, "lab (3d)", "300 ms late")
    assert names(in_time, "lab (3d)", "in time")


async def test_a_lag_of_exactly_the_maximum_is_in_time(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session")
    lab = await started(adapt_rate=True)
    for halvings, lag_s in ((1, 0.05), (2, 0.051), (3, 2.0)):
        await change(lab, halvings, lag_s)
    in_time, late, later = [record.getMessage() for record in records(caplog)]
    assert names(in_time, "in time", "FrequencyDivisor:2")
    assert names(late, "51 ms late", "FrequencyDivisor:4")
    assert names(later, "2000 ms late", "FrequencyDivisor:8", "failure 2")


async def test_a_request_for_the_default_rate_is_logged_as_such(caplog: pytest.LogCaptureFixture) -> None:
    lab = await started(adapt_rate=True)
    lab.server.answer = refusing("StreamFrames")
    lab.status.rate = ""
    await change(lab, 1, 0.3)
    assert any(names(each, "lab (3d)", "300 ms late", "default rate") for each in caplog.messages)


async def test_the_end_of_the_connection_ends_a_change_quietly(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session.stream_requests")
    lab = await started(adapt_rate=True)
    lab.server.answer = silent_to("StreamFrames")
    await change(lab, 1)
    lab.server.connection.end()
    await settle()
    [record] = caplog.records
    assert record.levelname == "DEBUG"
    assert names(record.getMessage(), "lab (3d)", "192.0.2.20:3020")
    assert lab.status.rate == "AllFrames"


async def test_cancelling_ends_every_task() -> None:
    tasks_before = asyncio.all_tasks()
    lab = await started(on_demand=True, adapt_rate=True)
    lab.server.answer = silent_to("StreamFrames")
    await change(lab, 1)
    assert len(asyncio.all_tasks() - tasks_before) == 2
    lab.changes.cancel()
    await settle()
    assert asyncio.all_tasks() == tasks_before


# --- one owner of the rate


async def test_a_stopped_stream_stays_stopped_while_its_rate_changes_and_resumes_at_that_rate() -> None:
    lab = await started(on_demand=True, idle_after_s=5.0, adapt_rate=True)
    await change(lab, 1)
    lab.has_subscribers = False
    await asyncio.sleep(6)
    lab.changes.lateness_changed(2)
    await asyncio.sleep(60)
    assert requests(lab) == [HALF, STOP]
    lab.has_subscribers = True
    await asyncio.sleep(1)
    assert requests(lab) == [HALF, STOP, "StreamFrames FrequencyDivisor:4"]


async def test_a_refused_resume_is_repeated_until_the_server_accepts_it() -> None:
    lab = await stopped()
    lab.server.answer = refusing("StreamFrames AllFrames")
    lab.has_subscribers = True
    await asyncio.sleep(2)
    assert requests(lab) == [STOP, START, START]
    lab.server.answer = obliging
    await asyncio.sleep(60)
    assert requests(lab) == [STOP, START, START, START]
    lab.has_subscribers = False
    await asyncio.sleep(60)
    lab.server.answer = refusing("StreamFrames AllFrames")
    lab.has_subscribers = True
    await asyncio.sleep(5)  # three refusals, which are not added to the first two
    lab.server.answer = obliging
    await asyncio.sleep(60)
    assert (lab.status.rate, lab.session.is_open) == ("AllFrames", True)


async def test_a_server_that_refuses_every_resume_is_left_with_a_reason() -> None:
    lab = await stopped()
    lab.server.answer = refusing("StreamFrames")
    lab.has_subscribers = True
    text = "refuses to send frames again after they were stopped; connecting"
    with pytest.raises(RequestError, match=text):
        await lab.session.monitor(lab.check_silence)
    assert requests(lab).count(START) == MAX_RESUMES


async def test_a_refused_stop_is_repeated_ever_later_and_not_once_frames_are_wanted_again() -> None:
    lab = await started(on_demand=True, idle_after_s=5.0)
    lab.server.connection.send_frames(1)
    lab.server.answer = refusing("StreamFrames Stop")
    lab.has_subscribers = False
    await asyncio.sleep(5.5)
    assert requests(lab) == [STOP]
    await asyncio.sleep(300)
    assert 8 < len(requests(lab)) < 20
    assert lab.status.state is StreamState.STREAMING
    assert lab.status.rate == "AllFrames"
    lab.has_subscribers = True
    num_before = len(requests(lab))
    await asyncio.sleep(300)
    assert len(requests(lab)) == num_before


async def test_a_defect_ends_the_session() -> None:
    lab = await started(on_demand=True)
    lab.has_defect = True
    with raises(DefectError, "ZeroDivisionError"):
        await lab.session.monitor(lab.check_silence)


async def test_tasks_that_are_cancelled_before_they_start_leave_nothing_behind() -> None:
    """A server may send OK, a frame and a bad packet at once. Python would print a warning on stderr."""
    lab = await started(on_demand=True)
    lab.changes.cancel()
    await settle()
    gc.collect()
