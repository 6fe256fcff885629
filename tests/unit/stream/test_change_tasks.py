"""Changes to a stream by demand and by lateness, with a scripted server."""

import asyncio
import logging
import re
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import DefectError, RequestError
from gateway.rtc3d.components import ComponentType
from gateway.stream.change_tasks import DEMAND_POLL_S, MAX_RESUMES, ChangeTasks
from gateway.stream.files import IgnoredFiles
from gateway.stream.session import Session
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl
from tests.unit.stream.scripted_server import ScriptedServer, obliging, read_parameters, refusing, silent_to
from tests.virtual_time import settle

START, STOP = "StreamFrames AllFrames", "StreamFrames Stop"
HALF = "StreamFrames FrequencyDivisor:2"


class Lab:
    """The change tasks of one stream after its handshake."""

    def __init__(self, **stream: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.has_subscribers = True
        self.has_defect = False
        source, settings = SourceSettings(name="lab", host="192.0.2.20"), StreamSettings(**stream)
        self.session = Session(
            source, settings, self.status, lambda *_: None, IgnoredFiles(), self.server.connect
        )
        self._control = StreamControl(source, settings, self.status, self.session, read_parameters)
        self.adaptation = ChangeTasks(
            source, settings, self.status, self.session, self._control, self._ask_for_subscribers
        )

    async def start(self) -> None:
        await self.session.connect()
        await self._control.start()
        self.adaptation.start()

    def _ask_for_subscribers(self) -> bool:
        if self.has_defect:
            raise ZeroDivisionError
        return self.has_subscribers

    async def check_silence(self) -> None:
        """Find nothing wrong."""

    @property
    def requests(self) -> list[str]:
        """The commands since the handshake."""
        return self.server.connection.commands[3:]


def records(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    """Return the records about demand and lateness."""
    return [record for record in caplog.records if re.search("subscriber|late|in time", record.getMessage())]


async def test_an_on_demand_stream_stops_without_subscribers_and_resumes_with_them() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    await asyncio.sleep(60)
    assert lab.requests == []
    lab.has_subscribers = False
    await asyncio.sleep(4.9)
    assert lab.requests == []
    await asyncio.sleep(0.1 + DEMAND_POLL_S)
    await settle()
    assert lab.requests == [STOP]
    assert lab.status.rate == ""
    await asyncio.sleep(60)
    lab.has_subscribers = True
    await asyncio.sleep(DEMAND_POLL_S)
    await settle()
    assert lab.requests == [STOP, START]
    assert lab.status.rate == "AllFrames"
    lab.adaptation.cancel()


async def test_each_stop_and_each_start_on_demand_happens_once_and_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "gateway.stream")
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    for has_subscribers in (False, True, False):
        lab.has_subscribers = has_subscribers
        await asyncio.sleep(60)
    assert lab.requests == [STOP, START, STOP]
    assert [record.getMessage() for record in records(caplog)] == [
        "lab (3d): no subscribers; the stream is stopped",
        "lab (3d): a subscriber appeared; frames are requested again",
        "lab (3d): no subscribers; the stream is stopped",
    ]
    lab.adaptation.cancel()


async def test_a_short_absence_of_subscribers_does_not_stop_an_on_demand_stream() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    for _ in range(5):
        lab.has_subscribers = not lab.has_subscribers
        await asyncio.sleep(4)
    assert lab.requests == []
    lab.adaptation.cancel()


async def test_other_streams_run_without_subscribers() -> None:
    lab = Lab(idle_after_s=5.0)
    lab.has_subscribers = False
    await lab.start()
    await asyncio.sleep(60)
    assert lab.requests == []


async def test_lateness_is_a_warning_once_and_its_end_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")
    lab = Lab(adapt_rate=True)
    await lab.start()
    for halvings, lag_s in ((1, 0.3), (2, 0.3), (1, 0.0), (0, 0.0)):
        lab.status.lag_measured(lag_s)
        lab.adaptation.lateness_changed(halvings)
        await settle()
    assert lab.requests == [HALF, "StreamFrames FrequencyDivisor:4", HALF, START]
    assert lab.status.rate == "AllFrames"
    assert [record.levelname for record in records(caplog)] == ["WARNING", "DEBUG", "DEBUG", "INFO"]
    first, second, third, last = [record.getMessage() for record in records(caplog)]
    assert first == "lab (3d): frames arrive 300 ms late; asked the server for FrequencyDivisor:2"
    assert second.endswith("asked the server for FrequencyDivisor:4 (failure 2 in a row)")
    assert third == "lab (3d): frames arrive in time; asked the server for FrequencyDivisor:2"
    assert last.startswith("lab (3d): frames arrive in time; asked the server for AllFrames, after ")


async def test_a_reduced_rate_is_requested_again_with_other_components() -> None:
    """The request for components has no rate; without another one, the full rate would reach a slow link."""
    lab = Lab(adapt_rate=True)
    await lab.start()
    lab.adaptation.lateness_changed(1)
    await settle()
    lab.adaptation.request_components((ComponentType.MARKERS,))
    await settle()
    assert lab.requests == [HALF, "StreamFrames AllFrames 3D", f"{HALF} 3D"]
    lab.adaptation.cancel()


async def test_by_default_the_server_is_asked_for_nothing(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")
    lab = Lab()
    await lab.start()
    lab.status.lag_measured(0.3)
    for halvings in (1, 0):
        lab.adaptation.lateness_changed(halvings)
        await settle()
    assert lab.requests == []
    assert [record.levelname for record in records(caplog)] == ["WARNING", "INFO"]
    late, in_time = [record.getMessage() for record in records(caplog)]
    assert late == "lab (3d): frames arrive 300 ms late"
    assert in_time.startswith("lab (3d): frames arrive in time, after ")


async def test_a_lag_of_exactly_the_maximum_is_in_time(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")
    lab = Lab(adapt_rate=True)
    await lab.start()
    for halvings, lag_s in ((1, 0.05), (2, 0.051), (3, 2.0)):
        lab.status.lag_measured(lag_s)
        lab.adaptation.lateness_changed(halvings)
        await settle()
    assert [record.getMessage() for record in records(caplog)] == [
        "lab (3d): frames arrive in time; asked the server for FrequencyDivisor:2",
        "lab (3d): frames arrive 51 ms late; asked the server for FrequencyDivisor:4",
        "lab (3d): frames arrive 2000 ms late; asked the server for FrequencyDivisor:8 (failure 2 in a row)",
    ]


async def test_a_request_for_the_default_rate_is_logged_as_such(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab(adapt_rate=True)
    await lab.start()
    lab.server.answer = refusing("StreamFrames")
    lab.status.rate_agreed("")
    lab.status.lag_measured(0.3)
    lab.adaptation.lateness_changed(1)
    await settle()
    assert "lab (3d): frames arrive 300 ms late; asked the server for its default rate" in caplog.messages


async def test_the_end_of_the_connection_ends_a_change_quietly(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream.change_tasks")
    lab = Lab(adapt_rate=True)
    await lab.start()
    lab.server.answer = silent_to("StreamFrames")
    lab.adaptation.lateness_changed(1)
    await settle()
    lab.server.connection.end()
    await settle()
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("DEBUG", "lab (3d): the connection to 192.0.2.20:3020 was closed by the server")
    ]
    assert lab.status.rate == "AllFrames"


async def test_cancelling_ends_every_task() -> None:
    tasks_before = asyncio.all_tasks()
    lab = Lab(on_demand=True, adapt_rate=True)
    await lab.start()
    lab.server.answer = silent_to("StreamFrames")
    lab.adaptation.lateness_changed(1)
    await settle()
    assert len(asyncio.all_tasks() - tasks_before) == 2
    lab.adaptation.cancel()
    await settle()
    assert asyncio.all_tasks() == tasks_before


# --- one owner of the rate


async def test_a_stopped_stream_stays_stopped_while_its_rate_changes_and_resumes_at_that_rate() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0, adapt_rate=True)
    await lab.start()
    lab.adaptation.lateness_changed(1)
    await settle()
    lab.has_subscribers = False
    await asyncio.sleep(6)
    lab.adaptation.lateness_changed(2)
    await asyncio.sleep(60)
    assert lab.requests == [HALF, STOP]
    lab.has_subscribers = True
    await asyncio.sleep(1)
    assert lab.requests == [HALF, STOP, "StreamFrames FrequencyDivisor:4"]
    lab.adaptation.cancel()


async def test_a_refused_resume_is_repeated_until_the_server_accepts_it() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    lab.has_subscribers = False
    await asyncio.sleep(6)
    lab.server.answer = refusing("StreamFrames AllFrames")
    lab.has_subscribers = True
    await asyncio.sleep(2)
    assert lab.requests == [STOP, START, START]
    lab.server.answer = obliging
    await asyncio.sleep(60)
    assert lab.requests == [STOP, START, START, START]
    assert lab.status.rate == "AllFrames"
    assert lab.session.is_open
    lab.adaptation.cancel()


async def test_a_server_that_refuses_every_resume_is_left_with_a_reason() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    lab.has_subscribers = False
    await asyncio.sleep(6)
    lab.server.answer = refusing("StreamFrames")
    lab.has_subscribers = True
    with pytest.raises(
        RequestError, match="refuses to send frames again after they were stopped; connecting"
    ):
        await lab.session.monitor(lab.check_silence)
    assert lab.requests.count(START) == MAX_RESUMES
    lab.adaptation.cancel()


async def test_a_refused_stop_is_repeated_ever_later_and_not_once_frames_are_wanted_again() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    await lab.start()
    lab.server.connection.send_frames(1)
    lab.server.answer = refusing("StreamFrames Stop")
    lab.has_subscribers = False
    await asyncio.sleep(5.5)
    assert lab.requests == [STOP]
    await asyncio.sleep(300)
    assert 8 < len(lab.requests) < 20
    assert lab.status.state is StreamState.STREAMING
    assert lab.status.rate == "AllFrames"
    lab.has_subscribers = True
    num_before = len(lab.requests)
    await asyncio.sleep(300)
    assert len(lab.requests) == num_before
    lab.adaptation.cancel()


async def test_a_defect_ends_the_session() -> None:
    lab = Lab(on_demand=True)
    await lab.start()
    lab.has_defect = True
    with pytest.raises(DefectError, match="defect in the gateway: ZeroDivisionError: "):
        await lab.session.monitor(lab.check_silence)
    lab.adaptation.cancel()
