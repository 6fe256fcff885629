"""A whole stream with a scripted server: reconnecting, and ending."""

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from contextlib import asynccontextmanager
from itertools import pairwise
from typing import Any

import pytest

from gateway.config.settings import ReconnectSettings, SourceSettings, StreamSettings
from gateway.messages.encode import Stamp
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.runtime.failures import HOLD_S, current_log_fields
from gateway.session.replies import Connection
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from gateway.session.supervisor import STEADY_S, Backoff, Callbacks, Listener, Supervisor
from tests.support.clocks import STEP_S, read_clocks, until
from tests.support.errors import names
from tests.support.records import levels
from tests.support.servers import markers_frame, packet
from tests.unit.session.scripted_server import ScriptedServer, read_parameters, refusing, silent_to
from tests.unit.session.session_lab import CollectedFiles

FIRST_DELAY_S, MAX_DELAY_S = 0.2, 10.0


class _Listener(Listener):
    def __init__(self, on_connected: Callable[[], None]) -> None:
        self._on_connected = on_connected

    def connected(self, stream: Supervisor, request: StreamFrames) -> None:  # noqa: ARG002 - Listener's
        self._on_connected()


class Lab:
    """A supervisor of one stream, and its server."""

    def __init__(self, **stream: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.published: list[tuple[RawFrame, Stamp]] = []
        self.files = CollectedFiles()
        self.has_subscribers = True
        self.has_defect = False
        self.restarts = self.connected = 0
        self._stream = StreamSettings(**stream)
        self.supervisor = self.new_supervisor()

    def new_supervisor(self) -> Supervisor:
        return Supervisor(
            SourceSettings(name="lab", host="192.0.2.20"),
            self._stream,
            self.status,
            Callbacks(
                publish=self._publish,
                skip=lambda *_: 0,
                read_parameters=read_parameters,
                on_restart=self._on_restart,
                files=self.files,
                has_subscribers=self._has_subscribers,
            ),
            _Listener(lambda: self._on_connected()),  # noqa: PLW0108 - tests replace the method
            connect=self.server.connect,
            read_clocks=read_clocks,
        )

    def _publish(self, frame: RawFrame, stamp: Stamp, _wanted: frozenset[ComponentType]) -> None:
        self.published.append((frame, stamp))

    def _on_connected(self) -> None:
        self.connected += 1

    def _has_subscribers(self, _components: Collection[ComponentType]) -> bool:
        if self.has_defect:
            _raise_defect()
        return self.has_subscribers

    def _on_restart(self) -> None:
        self.restarts += 1

    @property
    def delays_s(self) -> list[float]:
        """The virtual time between each attempt to connect and the next, in s."""
        return [after - before for before, after in pairwise(self.server.tried_s)]

    async def tried(self, times: int) -> None:
        await until(lambda: len(self.server.tried_s) >= times)

    async def ready(self, connections: int = 1) -> None:
        await until(lambda: len(self.server.connections) == connections and self.supervisor.session)


@asynccontextmanager
async def running(lab: Lab) -> AsyncIterator[asyncio.Task[None]]:
    task = asyncio.create_task(lab.supervisor.run())
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def assert_delays(delays_s: list[float], nominal_s: list[float], connected_s: float = 0.0) -> None:
    """Each delay is shortened by at most half. Timers add almost nothing, connections ``connected_s``."""
    for delay_s, limit_s in zip(delays_s, nominal_s, strict=True):
        assert limit_s / 2 <= delay_s + 1e-6
        assert delay_s <= limit_s + connected_s + 1e-6


def test_delays_double_up_to_the_maximum_and_are_shortened_at_random() -> None:
    reconnect = ReconnectSettings(first_delay_s=FIRST_DELAY_S, max_delay_s=MAX_DELAY_S)
    runs = [
        [backoff.delay_after(0.0, had_data=False) for _ in range(9)]
        for backoff in (Backoff(reconnect) for _ in range(50))
    ]
    for delays_s in runs:
        assert_delays(delays_s, [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10, 10, 10])
    assert len({run[0] for run in runs}) > 1
    assert_delays([Backoff(reconnect).delay_after(STEADY_S, had_data=True)], [0.2])


async def test_delays_grow_while_the_server_is_away(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.session")
    lab = Lab()
    lab.server.refuses = True
    async with running(lab):
        await lab.tried(9)
    assert_delays(lab.delays_s[:8], [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10, 10])
    assert lab.status.state is StreamState.WAITING
    assert lab.status.last_error == "connection refused by the test"
    assert lab.status.tries == 9
    levels = [record.levelno for record in caplog.records]
    assert [level for level in levels if level > logging.DEBUG] == [logging.WARNING]


@pytest.mark.parametrize("data", [markers_frame(1, (0.0, 0.0, 0.0)), packet(4)], ids=["frame", "No Data"])
async def test_delays_start_again_after_a_connection_that_brought_data(data: bytes) -> None:
    lab = Lab()
    lab.server.refuses = True
    async with running(lab):
        await lab.tried(7)
        lab.server.refuses = False
        await lab.ready()
        lab.server.connection.send(data)
        lab.server.refuses = True
        tries = len(lab.server.tried_s)
        ended_s = asyncio.get_running_loop().time()
        lab.server.connection.end()
        await lab.tried(tries + 2)
    first_s, second_s = lab.server.tried_s[tries : tries + 2]
    assert_delays([first_s - ended_s, second_s - first_s], [0.2, 0.4])


async def test_delays_continue_to_grow_if_connections_bring_nothing() -> None:
    lab = Lab()
    lab.server.answer = refusing("StreamFrames")
    async with running(lab):
        await lab.tried(8)
    assert_delays(lab.delays_s[:7], [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10])
    assert lab.status.reconnects >= 7


async def test_recovery_is_logged_once_with_its_duration_when_it_has_held(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    monkeypatch.setattr("gateway.runtime.failures.monotonic", lambda: now_s)
    caplog.set_level(logging.INFO, "gateway.session")
    lab = Lab()
    lab.server.refuses = True
    async with running(lab):
        await lab.tried(3)
        lab.server.refuses = False
        await lab.ready()
        lab.server.connection.send_frames(1)
        lab.status.check()
        now_s += HOLD_S
        lab.status.check()
    refused, connected, recovered = caplog.messages
    assert refused == "lab (3d): connection refused by the test"
    assert names(connected, "lab (3d)", "192.0.2.20:3020", "StreamFrames AllFrames")
    assert names(recovered, "lab (3d)", "5.0 s", "3 failures")


async def test_a_server_that_breaks_again_and_again_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.session")
    lab = Lab()
    async with running(lab):
        for connection in range(1, 6):
            await lab.ready(connection)
            lab.server.connection.send_frames(connection)
            lab.status.check()
            lab.server.connection.end()
    assert levels(caplog, logging.INFO) == ["INFO", "INFO", "WARNING"]
    connected, streaming, lost = caplog.messages
    assert names(connected, "lab (3d)", "192.0.2.20:3020", "StreamFrames AllFrames")
    assert names(streaming, "lab (3d)", "idle → streaming")
    assert names(lost, "lab (3d)", "192.0.2.20:3020", "by the server")


async def test_a_server_that_sends_some_frames_and_breaks_is_tried_as_rarely_as_one_that_is_off() -> None:
    lab = Lab()
    async with running(lab):
        for connection in range(1, 10):
            await lab.ready(connection)
            lab.server.connection.send_frames(1, 2, 3)
            await until(lambda: len(lab.published) == 3 * connection)  # noqa: B023 - called at once
            lab.server.connection.end()
        await lab.tried(10)
    # Between two attempts, there is always a delay of the shortest kind, however long the connection lasted.
    assert_delays(lab.delays_s[:9], [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10, 10, 10], connected_s=2 * STEP_S)


def test_a_steady_connection_forgets_the_breaks_before_it() -> None:
    backoff = Backoff(ReconnectSettings(first_delay_s=FIRST_DELAY_S, max_delay_s=MAX_DELAY_S))
    delays_s = [backoff.delay_after(lasted_s, had_data=True) for lasted_s in (1, 1, 1, STEADY_S)]
    assert delays_s[2] > FIRST_DELAY_S >= delays_s[3]


async def test_the_time_that_an_attempt_takes_counts_as_waiting() -> None:
    """A server that hangs and recovers is not kept waiting for its client even longer."""
    lab = Lab()
    lab.server.answer = silent_to("")
    async with running(lab):
        await asyncio.sleep(300)
    assert len(lab.delays_s) > 5
    assert max(lab.delays_s) - min(lab.delays_s) < 0.2


@pytest.mark.interpreted
async def test_a_defect_that_replaces_the_cancellation_does_not_keep_the_stream_running(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab()
    async with running(lab) as task:
        await lab.ready()
        monkeypatch.setattr(lab.supervisor.session, "close", _raise_defect)
        task.cancel()
        await asyncio.wait([task], timeout=10)
        assert task.cancelled()
    assert [record.levelname for record in caplog.records if record.exc_info] == ["ERROR"]


async def test_a_cancelled_future_that_a_session_waits_for_is_a_defect(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab()
    cancelled: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    cancelled.cancel()

    async def read_cancelled(connection: Connection) -> ParsedParameters:
        await cancelled
        return await read_parameters(connection)

    monkeypatch.setattr(
        lab.supervisor, "_callbacks", lab.supervisor._callbacks._replace(read_parameters=read_cancelled)
    )
    async with running(lab):
        await lab.tried(3)
    assert "CancelledError" in lab.status.last_error
    assert [record.levelname for record in caplog.records if record.exc_info] == ["ERROR"]


async def test_a_silent_measurement_leads_to_a_new_connection() -> None:
    lab = Lab()
    async with running(lab):
        await lab.ready()
        lab.server.connection.send_frames(1)
        await lab.ready(2)
        lab.server.connection.send_frames(2)
        assert lab.status.state is StreamState.STREAMING
    assert (lab.connected, lab.status.session, lab.status.reconnects) == (2, 2, 1)
    assert [stamp.session for _, stamp in lab.published] == [1, 2]
    assert names(lab.status.last_error, "measurement")


async def test_a_defect_is_an_error_with_its_traceback_once_and_is_retried_ever_later(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = Lab()
    monkeypatch.setattr(lab, "_on_connected", _raise_defect)
    lab.supervisor = lab.new_supervisor()
    async with running(lab):
        await lab.tried(7)
    assert_delays(lab.delays_s[:6], [0.2, 0.4, 0.8, 1.6, 3.2, 6.4])
    [error] = [record for record in caplog.records if record.levelno >= logging.WARNING]
    text = "defect in the gateway: ZeroDivisionError: by the test; connecting again; report this with the log"
    assert (error.levelname, error.message) == ("ERROR", f"lab (3d): {text}")
    assert error.exc_info is not None
    assert lab.status.last_error == text


async def test_a_defect_after_data_does_not_start_the_delays_again() -> None:
    """Data prove that a server is back, but a gateway with a defect must not reconnect in a tight loop."""
    lab = Lab(on_demand=True)
    lab.server.refuses = True
    async with running(lab):
        await lab.tried(6)
        lab.server.refuses = False
        await lab.ready()
        lab.server.connection.send_frames(1)
        await until(lambda: lab.published)
        lab.has_defect = True
        await until(lambda: lab.supervisor.session is None)
        lab.has_defect = False
        await lab.ready(2)
    assert lab.delays_s[-1] > 3


def _raise_defect(*_: object) -> None:
    raise ZeroDivisionError("by the test")


async def test_cancelling_sends_bye() -> None:
    lab = Lab()
    async with running(lab):
        await lab.ready()
    assert lab.server.connection.commands[-1] == "Bye"
    assert not lab.server.connection.is_open


async def test_records_carry_the_source_the_stream_and_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab()
    seen: list[Mapping[str, str]] = []
    monkeypatch.setattr(lab, "_on_connected", lambda: seen.append(current_log_fields()))
    lab.supervisor = lab.new_supervisor()
    async with running(lab):
        await until(lambda: seen)
    assert seen == [{"source": "lab", "stream": "3d", "peer": "192.0.2.20:3020"}]


async def test_frames_that_stay_late_halve_the_rate() -> None:
    lab = Lab(adapt_rate=True)
    async with running(lab):
        await lab.ready()
        for time_ms in range(0, 5000, 10):
            if time_ms == 3000:
                await asyncio.sleep(0.2)  # from here on, every frame is 200 ms late
            await asyncio.sleep(0.01)
            lab.server.connection.send_frames(time_ms)
        assert lab.server.connection.commands[3:] == ["StreamFrames FrequencyDivisor:2"]


async def test_a_stream_on_demand_follows_its_subscribers() -> None:
    lab = Lab(on_demand=True, idle_after_s=5.0)
    async with running(lab):
        await lab.ready()
        lab.server.connection.send(packet(4))
        lab.has_subscribers = False
        await asyncio.sleep(10)
        lab.has_subscribers = True
        await asyncio.sleep(1)
        streamed = [text for text in lab.server.connection.commands if text.startswith("StreamFrames")]
        assert streamed[-2:] == ["StreamFrames Stop", "StreamFrames AllFrames"]
