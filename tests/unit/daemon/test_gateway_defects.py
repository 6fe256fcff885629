"""A whole gateway in virtual time: a defect ends what it concerns, and nothing else."""

import asyncio
import logging
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.daemon.source import Source
from gateway.publish.fan_out import FanOut
from gateway.queries.server_requests import ParameterRefresh
from gateway.rtc3d.client_protocol import ClientProtocol
from gateway.rtc3d.components import ComponentType
from gateway.runtime.failures import current_log_fields
from gateway.session.ingest import Ingest
from gateway.session.session import Session
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from gateway.session.streams import AutomaticStreams
from gateway.session.supervisor import Supervisor
from tests.support.clocks import settle
from tests.support.errors import names
from tests.unit.daemon.scripted_sources import Servers
from tests.unit.daemon.test_gateway import (
    RecordingOutput,
    connected,
    events,  # noqa: F401 - a fixture
    running,
    settings,
    streaming,
    subscribe,
)

pytestmark = pytest.mark.usefixtures("servers", "threads")


def let_fail(monkeypatch: pytest.MonkeyPatch, owner: type, method: str) -> set[str]:
    """Let a method raise in the sources whose names are in the set that is returned."""
    failing: set[str] = set()
    original = getattr(owner, method)

    def call(self: Any, *args: Any, **options: Any) -> Any:
        owners = [getattr(self, name, None) for name in ("name", "_source", "_status")]
        names = {getattr(owner, "name", owner) for owner in owners} | {current_log_fields().get("source")}
        if any(str(name).partition(" ")[0] in failing for name in names):
            raise ZeroDivisionError("by the test")
        return original(self, *args, **options)

    monkeypatch.setattr(owner, method, call)
    return failing


class PanicException(BaseException):
    """What a library in Rust raises when it panics: no Exception, and each library has a class of its own."""


def let_outputs_fail(
    monkeypatch: pytest.MonkeyPatch, method: str, defect: type[BaseException] = ZeroDivisionError
) -> list[str]:
    """Let a method raise of outputs whose address is in the list that is returned."""
    failing = ["broken"]
    original = getattr(RecordingOutput, method)

    def call(self: Any, *args: Any, **options: Any) -> Any:
        if self.settings.address in failing:
            raise defect("by the test")
        return original.__get__(self) if isinstance(original, property) else original(self, *args, **options)

    monkeypatch.setattr(RecordingOutput, method, property(call) if isinstance(original, property) else call)
    return failing


DEFECTS = [
    *((StreamStatus, name) for name in ("disconnected", "connecting", "check")),
    *((Source, name) for name in ("publish_status", "_status_message", "_read_parameters", "_on_state")),
    *((FanOut, name) for name in ("publish", "publish_clock", "maintain")),
    *((Session, name) for name in ("_on_event", "_report_change", "close")),
    *((AutomaticStreams, "check"), (Supervisor, "check_rate"), (ParameterRefresh, "_due_s")),
    *((Ingest, "receive"), (ClientProtocol, "receive")),
]


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("owner", "method"), DEFECTS, ids=[f"{each[0].__name__}.{each[1]}" for each in DEFECTS]
)
async def test_a_defect_in_one_source_is_logged_once_and_the_source_recovers(
    servers: Servers,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    owner: type,
    method: str,
) -> None:
    caplog.set_level(logging.INFO)
    failing = let_fail(monkeypatch, owner, method)
    async with streaming(settings("lab", "hall")) as gateway:
        failing.add("lab")
        for _ in range(20):  # the servers send frames, and that of lab breaks off
            for name in ("lab", "hall"):
                servers[name].connection.send_frames(1)
            await asyncio.sleep(1)
            servers["lab"].connection.end()
            await asyncio.sleep(1)
        assert len(servers["hall"].connections) == 1
        errors = [record for record in caplog.records if record.levelno >= logging.ERROR]
        assert len(errors) == len({record.getMessage().split("(")[0] for record in errors})
        assert 1 <= len([record for record in errors if record.exc_info]) <= 2
        assert {current.getMessage()[:3] for current in errors} == {"lab"}
        failing.clear()
        before = gateway.sources[0].fan_out.frames[ComponentType.MARKERS]
        await asyncio.sleep(60)
        await connected(gateway)
        servers["lab"].connection.send_frames(1)
        await settle()
        assert gateway.sources[0].fan_out.frames[ComponentType.MARKERS] > before


@pytest.mark.parametrize("defect", [ZeroDivisionError, PanicException])
@pytest.mark.parametrize("method", ["health", "maintain", "query_results", "stop_queries", "close"])
async def test_a_defect_in_one_output_does_not_stop_the_others(
    servers: Servers,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    method: str,
    defect: type[BaseException],
) -> None:
    """Zenoh panics if the clock is beyond 2106, which ended the gateway with all outputs."""
    let_outputs_fail(monkeypatch, method, defect)
    async with streaming(settings(example="broken", other="elsewhere")):
        messages = subscribe("elsewhere")
        for _ in range(5):
            servers["lab"].connection.send_frames(1)
            await asyncio.sleep(1)
        assert len(messages) == 5
    assert len([record for record in caplog.records if record.exc_info]) == 1
    assert ("close", "elsewhere") in RecordingOutput.events


@pytest.mark.parametrize(
    "method",
    [
        *("start", "serve_queries", "publisher", "frame_publisher", "count_losses", "watch_wanted"),
        *("announce", "withdraw", "show_streaming", "show_measurement", "publish_parameters"),
    ],
)
async def test_a_reload_with_a_defect_in_one_output_is_complete_and_the_next_one_repairs_it(
    servers: Servers, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, method: str
) -> None:
    wanted = settings("lab", "hall", example="broken", other="elsewhere")
    async with streaming(settings("lab", "yard", other="elsewhere")) as gateway:
        servers["yard"].connection.send_frames(1)
        failing = let_outputs_fail(monkeypatch, method)
        changes = await gateway.reload(wanted)
        assert changes == ["output example changed", "source yard removed", "source hall added"]
        await connected(gateway)
        elsewhere, repaired = subscribe("elsewhere", source="hall"), subscribe("broken", source="hall")
        servers["hall"].connection.send_frames(1)
        await settle()
        assert len(elsewhere) == 1
        error = next(record for record in caplog.records if record.exc_info)
        assert error.levelname == "ERROR"
        assert names(error.getMessage(), "example", "ZeroDivisionError: by the test")
        assert names(gateway.outputs[0].health().problem, "reload")
        failing.clear()
        repaired.clear()
        assert await gateway.reload(wanted) == ["output example changed"]
        assert gateway.outputs[0].health().connected
        servers["hall"].connection.send_frames(2)
        await settle()
        assert (len(elsewhere), len(repaired)) == (2, 1)


async def test_messages_that_a_defect_leaves_without_a_publisher_count_as_lost(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    let_outputs_fail(monkeypatch, "publisher")
    async with streaming(settings(example="broken")) as gateway:
        servers["lab"].connection.send_frames(1, 2, 3)
        [(_, status)] = gateway.sources[0].fan_out.outputs
        assert [(loss.cause, loss.frames) for loss in status.losses if loss.frames] == [("defect", 3)]


async def test_a_reload_with_a_defect_in_one_source_starts_the_others_and_can_be_repeated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Broken(Source):
        def __init__(self, settings: SourceSettings, *rest: Any) -> None:
            if settings.name == "hall":
                raise ZeroDivisionError
            super().__init__(settings, *rest)

    wanted = settings("lab@other", "hall@other", "yard@other")
    async with streaming(settings("lab", "hall", "yard")) as gateway:
        with monkeypatch.context() as patch:
            patch.setattr("gateway.daemon.gateway.Source", Broken)
            with pytest.raises(ZeroDivisionError):
                await gateway.reload(wanted)
        assert [source.settings.host for source in gateway.sources] == ["other", "hall", "other"]
        assert await gateway.reload(wanted) == ["source hall changed"]
        await connected(gateway)
        assert [source.settings.host for source in gateway.sources] == ["other", "other", "other"]


async def test_the_tasks_of_a_source_that_end_or_are_cancelled_are_started_again(
    servers: Servers, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ends = iter([asyncio.sleep, asyncio.CancelledError])
    run = AutomaticStreams.run

    async def end(streams: AutomaticStreams) -> None:
        match next(ends, None):
            case None:
                await run(streams)
            case asyncio.CancelledError:
                raise asyncio.CancelledError

    monkeypatch.setattr(AutomaticStreams, "run", end)
    async with running(settings()) as gateway:
        await asyncio.sleep(5)
        await connected(gateway)
        assert servers["lab"].connection.is_open
    errors = [record.message for record in caplog.records if record.levelname == "ERROR"]
    for what in ("the streams", "the source"):  # which of the two had ended
        assert any(names(error, "lab", f"RuntimeError: {what}") for error in errors)


async def test_a_source_that_had_a_defect_continues_its_numbers_and_shows_why(
    servers: Servers, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = let_fail(monkeypatch, AutomaticStreams, "check")
    async with streaming(settings("lab", "hall")) as gateway:
        messages = subscribe("local", source="lab")
        servers["lab"].connection.send_frames(1)
        failing.add("lab")
        await asyncio.sleep(1.01)
        failing.clear()
        status = gateway.sources[0].statuses[0]
        assert status.state is StreamState.WAITING
        assert names(status.last_error, "ZeroDivisionError: by the test", "source")
        await connected(gateway)
        servers["lab"].connection.send_frames(2)
        await settle()
    assert [(message.sequence, message.session) for message in messages] == [(0, 1), (1, 2)]
