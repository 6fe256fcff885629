"""One source with a scripted server, in virtual time: its status, parameters, files and recordings."""

import asyncio
import errno
import logging
import os
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.daemon.source import Source, SourceHistory
from gateway.errors import QueryError
from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.queries.answers import ServerAnswer
from gateway.queries.questions import Question
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.runtime.failures import current_log_fields
from gateway.runtime.workers import WorkerThread
from gateway.session.c3d_files.spool import Spool
from gateway.session.replies import UNANSWERED
from gateway.session.state import StreamState
from tests.support.clocks import settle, until
from tests.support.errors import names, raises
from tests.support.servers import c3d_file, packet
from tests.support.toy_output import ToyOutput, ToyPublisher
from tests.unit.daemon.scripted_sources import Servers
from tests.unit.session.scripted_server import ScriptedServer

HOST = "192.0.2.20"
STREAM = "lab (3d 6d analog force event)"
TWO_STREAMS = (
    StreamSettings(components=(ComponentType.MARKERS,)),
    StreamSettings(components=(ComponentType.ANALOG,)),
)


class Lab:
    """A source, its server, its output, and what it reports."""

    def __init__(
        self,
        servers: Servers,
        spool: Spool,
        history: SourceHistory | None = None,
        *,
        output: ToyOutput | None = None,
        **settings: Any,
    ) -> None:
        self.server: ScriptedServer = servers[HOST]
        self.output = output or ToyOutput()
        # An interval of 0 cannot be configured. Here, a refresh always reaches the server.
        of_source = SourceSettings(name="lab", host=HOST, **settings).model_copy(
            update={"fresh_interval_s": 0.0}
        )
        history = history or SourceHistory(of_source, ())
        history.fan_out.set_outputs([self.output])
        self.source = Source(of_source, history, spool)

    def messages(self, component: str) -> list[Any]:
        return [decode(message) for topic, message in self.output.messages if topic.path == (component,)]

    async def connected(self, sessions: int = 1) -> None:
        await until(lambda: sum(1 for each in self.source.streams if each.session) == sessions)
        await settle()

    def count(self, command: str) -> int:
        """Return how often the server received a command that begins with this text."""
        return sum(
            each.startswith(command) for connection in self.server.connections for each in connection.commands
        )


NewLab = Callable[..., Lab]


@pytest.fixture
def new_lab(servers: Servers, tmp_path: Path) -> NewLab:
    """Return a function that makes a source of the server, with its own spool or another one."""

    def make(history: SourceHistory | None = None, *, spool: Spool | None = None, **settings: Any) -> Lab:
        return Lab(servers, spool or Spool(tmp_path, max_files=10, max_bytes=1000), history, **settings)

    return make


@asynccontextmanager
async def running(lab: Lab, sessions: int = 1) -> AsyncIterator[None]:
    """Run the source, from when it has so many sessions until the block ends."""
    task = asyncio.create_task(lab.source.run())
    try:
        await lab.connected(sessions)
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def messages_of(caplog: pytest.LogCaptureFixture, level: int) -> list[str]:
    return [record.message for record in caplog.records if record.levelno == level]


async def receive_files(lab: Lab, number: int) -> None:
    """Run the source until it has received files of 600 bytes."""
    async with running(lab):
        for _ in range(number):
            lab.server.connection.send(packet(5, c3d_file(b"", 600)))
            await settle()
        assert len(lab.server.connections) == 1


async def test_status_and_clock_are_numbered_and_queries_get_the_newest_status(new_lab: NewLab) -> None:
    lab = new_lab()
    for sequence in (-1, 0, 1):
        answer = await lab.source.queries.answer(Question("status"))
        assert decode(answer.payload).sequence == sequence
        lab.source.publish_status()
    for component in ("status", "clock"):
        assert [message.sequence for message in lab.messages(component)] == [0, 1, 2]


async def test_problems_with_the_status_are_logged_with_the_source(new_lab: NewLab) -> None:
    class RecordingPublisher(ToyPublisher):
        def publish(self, message: bytes) -> None:
            fields.append(current_log_fields())
            super().publish(message)

    class RecordingOutput(ToyOutput):
        def publisher(self, topic: Topic) -> ToyPublisher:
            super().publisher(topic)
            return RecordingPublisher(self, topic)

    fields: list[Mapping[str, str]] = []
    new_lab(output=RecordingOutput()).source.publish_status()
    assert fields == [{"source": "lab"}, {"source": "lab"}]


async def test_the_status_describes_every_stream_and_output(new_lab: NewLab) -> None:
    lab = new_lab(streams=TWO_STREAMS)
    lab.source.publish_status()
    [status] = lab.messages("status")
    assert (status.source, status.server) == ("lab", f"{HOST}:3020")
    assert [stream.components for stream in status.streams] == ["3d", "analog"]
    assert [output.name for output in status.outputs] == ["toy"]


@pytest.mark.parametrize(
    ("states", "runs"),
    [
        ((StreamState.STREAMING, StreamState.NO_MEASUREMENT), True),
        ((StreamState.NO_MEASUREMENT, StreamState.STREAMING), True),
        ((StreamState.NO_MEASUREMENT, StreamState.WAITING), False),
        ((StreamState.WAITING, StreamState.HANDSHAKING), None),
    ],
)
async def test_a_measurement_runs_if_any_stream_has_frames(
    new_lab: NewLab,
    monkeypatch: pytest.MonkeyPatch,
    states: tuple[StreamState, StreamState],
    runs: bool | None,
) -> None:
    """Takes that follow it must not end while one of the streams still has its frames."""
    lab, shown = new_lab(streams=TWO_STREAMS), [None]
    monkeypatch.setattr(lab.output, "show_measurement", lambda _source, runs: shown.append(runs))
    for status, state in zip(lab.source.statuses, states, strict=True):
        former, status.state = status.state, state
        status.on_state(former)
    assert shown[-1] is runs


@pytest.mark.parametrize("gives", [True, False])
async def test_only_parameters_show_that_a_silent_stream_is_answered(new_lab: NewLab, *, gives: bool) -> None:
    """If the server stops giving any, the other stream does not get some by that."""
    lab = new_lab(streams=TWO_STREAMS)
    lab.source.statuses[1].add_limitation(UNANSWERED)
    cache = lab.source.queries.parameters
    answer = ServerAnswer((), b"<a/>", ParsedParameters(Parameters(), ()), 1, 1) if gives else None
    await lab.source._announce_parameters(answer, cache.version + 1)
    assert (UNANSWERED in lab.source.statuses[1].limitations) is not gives


@pytest.mark.parametrize("better", [0, 1])
async def test_the_clock_with_the_least_uncertainty_is_published(new_lab: NewLab, better: int) -> None:
    lab = new_lab(streams=TWO_STREAMS)
    for index, num_frames in ((better, 5000), (1 - better, 300)):
        for number in range(num_frames):
            time_us = 10_000 * number
            lab.source.statuses[index].clock.observe(time_us, number, 10**15 + time_us + number * 7919 % 1000)
    clocks = [status.clock for status in lab.source.statuses]
    assert clocks[better].uncertainty_us < clocks[1 - better].uncertainty_us
    lab.source.publish_status()
    [message] = lab.messages("clock")
    assert message.components == ("3d", "analog")[better]
    assert message.clock.uncertainty_us == clocks[better].uncertainty_us


async def test_a_stream_without_a_clock_is_never_the_best(new_lab: NewLab) -> None:
    lab = new_lab(streams=TWO_STREAMS)
    for number in range(300):
        lab.source.statuses[1].clock.observe(10_000 * number, number, 10**15 + 10_000 * number)
    lab.source.publish_status()
    [message] = lab.messages("clock")
    assert (message.components, bool(message.clock.has_clock)) == ("analog", True)


async def test_the_source_shows_streaming_while_any_stream_has_frames(new_lab: NewLab) -> None:
    lab = new_lab(streams=TWO_STREAMS)
    async with running(lab, sessions=2):
        assert True not in lab.output.streaming
        first, second = lab.server.connections
        first.send_frames(1)
        second.send(packet(3, b"\0\0\0\0"))  # a frame without components
        assert lab.output.streaming[-1] is True
        for connection, is_streaming in ((second, True), (first, False)):
            connection.end()
            await settle()
            assert lab.output.streaming[-1] is is_streaming


async def test_a_file_is_stored_and_announced(
    new_lab: NewLab, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    lab, content = new_lab(), c3d_file(b"a file", 600)
    async with running(lab):
        lab.server.connection.send(packet(5, content))
        await settle()
        [(source, file)] = lab.output.files
        assert (source, file.num_bytes) == ("lab", 600)
        answer = await lab.source.queries.answer(Question("c3d"))
        assert (answer.payload, answer.attachment) == (content, file.description)
    path = tmp_path / file.description["name"]
    assert file.path == path
    assert lab.source.spool.newest("lab") == path
    assert any(names(message, "lab", "600 bytes", path) for message in caplog.messages)


async def test_the_files_that_a_new_one_displaces_are_logged_with_it(
    new_lab: NewLab, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    lab = new_lab(spool=Spool(tmp_path, max_files=1, max_bytes=1000))
    await receive_files(lab, 2)
    path = lab.output.files[1][1].path
    [line] = [message for message in caplog.messages if path.name in message]
    assert names(line, path, "(1)")


async def test_a_file_is_announced_although_an_old_one_cannot_be_deleted(
    new_lab: NewLab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_path: Path, **_options: bool) -> None:
        raise PermissionError(1, "Operation not permitted")

    lab = new_lab(spool=Spool(tmp_path, max_files=1, max_bytes=1000))
    with monkeypatch.context() as disk:
        disk.setattr(Path, "unlink", refuse)
        await receive_files(lab, 3)
    assert len(lab.output.files) == 3
    [warning] = [text for text in messages_of(caplog, logging.WARNING) if "C3D" in text]
    assert names(warning, "lab", lab.output.files[0][1].path, "Operation not permitted")


async def test_files_that_cannot_be_stored_are_logged_once(
    new_lab: NewLab, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "c3d").write_text("a file in place of the folder")
    lab = new_lab(spool=Spool(tmp_path / "c3d", max_files=10, max_bytes=1000))
    await receive_files(lab, 6)
    [error] = messages_of(caplog, logging.ERROR)
    assert names(error, STREAM, "600 bytes", tmp_path / "c3d", os.strerror(errno.EEXIST))
    [end] = [record for record in caplog.records if record.args and "6 messages (C3D file)" in record.args]
    assert end.levelname == "INFO"
    assert lab.output.files == []


async def test_a_file_that_breaks_off_with_the_connection_is_logged(
    new_lab: NewLab, caplog: pytest.LogCaptureFixture
) -> None:
    lab = new_lab()
    async with running(lab):
        lab.server.connection.send(packet(5, c3d_file(b"", 600))[:-1])
        lab.server.connection.end()
        await settle()
    assert lab.source.spool.newest("lab") is None
    [error] = messages_of(caplog, logging.ERROR)
    assert names(error, STREAM, "600 bytes", "599 bytes")


async def test_a_missing_file_is_an_error_for_the_peer(
    new_lab: NewLab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = new_lab()
    with raises(QueryError, "lab", code="nothing-yet"):
        await lab.source.queries.answer(Question("c3d"))
    monkeypatch.setattr(Spool, "newest", lambda _spool, _source: tmp_path / "gone.c3d")
    with raises(QueryError, "lab", os.strerror(errno.ENOENT), code="nothing-yet"):
        await lab.source.queries.answer(Question("c3d"))
    monkeypatch.setattr(WorkerThread, "submit", lambda _thread, _call: Future())
    with raises(QueryError, "4 s", code="timeout"):
        await lab.source.queries.answer(Question("c3d"))


async def test_a_defect_in_announcing_a_file_is_an_error_and_streams_continue(
    new_lab: NewLab, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab = new_lab()
    monkeypatch.setattr(
        lab.output, "files", None
    )  # what takes the description of a file raises AttributeError
    await receive_files(lab, 1)
    [error] = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert names(error.message, "lab", "AttributeError")
    assert error.exc_info is not None


async def test_recording_is_controlled_on_the_first_connection_that_works(new_lab: NewLab) -> None:
    lab = new_lab(streams=TWO_STREAMS, remote_control=True)
    start = Question("recording", set="start")
    with raises(QueryError, code="no-connection"):
        await lab.source.queries.answer(start)
    async with running(lab, sessions=2):
        first, second = lab.server.connections
        for expected in ((1, 0), (1, 1)):
            answer = await lab.source.queries.answer(start)
            assert (first.num_recording_packets, second.num_recording_packets) == expected
            first.end()
            await settle()
            assert answer.payload == b'{"source":"lab","sent":"start"}'
