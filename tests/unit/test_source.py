"""One source with a scripted server, in virtual time: its status, parameters, files and recordings."""

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.c3d_spool import Spool
from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import QueryError, SpoolError
from gateway.log import current_log_fields
from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.contract import ServerParameters
from gateway.publish.fan_out import FanOut
from gateway.queries.questions import Question
from gateway.rtc3d.components import ComponentType
from gateway.source import Source
from tests.servers import packet
from tests.toy_output import ToyOutput, ToyPublisher
from tests.unit.scripted_sources import Servers
from tests.unit.stream.scripted_server import ScriptedServer
from tests.unit.stream.virtual_time import settle, until

HOST = "192.0.2.20"
STREAM = "lab (3d 6d analog force event)"
TWO_STREAMS = (
    StreamSettings(components=(ComponentType.MARKERS,)),
    StreamSettings(components=(ComponentType.ANALOG,)),
)


class BrokenSpool(Spool):
    """A folder on a disk that is full."""

    def store(self, source: str, content: bytes) -> Path:
        raise SpoolError(f"{len(content)} bytes from {source} cannot be kept; check the disk")


class Lab:
    """A source, its server, its output, and what it reports."""

    def __init__(
        self,
        servers: Servers,
        spool: Spool,
        before: Source | None = None,
        *,
        output: ToyOutput | None = None,
        **settings: Any,
    ) -> None:
        self.server: ScriptedServer = servers[HOST]
        self.threads = servers.threads
        self.output = output or ToyOutput()
        self.parameters: list[tuple[str, ServerParameters]] = []
        self.files: list[tuple[str, dict[str, Any]]] = []
        self.source = Source(
            # An interval of 0 cannot be configured. Here, a refresh always reaches the server.
            SourceSettings(name="lab", host=HOST, **settings).model_copy(update={"fresh_interval_s": 0.0}),
            FanOut("lab", [self.output]),
            spool,
            self._publish_parameters,
            lambda *each: self.files.append(each),
            before,
        )

    async def _publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        self.parameters.append((source, parameters))

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


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path, max_files=10, max_bytes=1000)


@asynccontextmanager
async def running(lab: Lab) -> AsyncIterator[None]:
    task = asyncio.create_task(lab.source.run())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


# Status --------------------------------------------------------------------------------------


async def test_status_and_clock_are_numbered(servers: Servers, spool: Spool) -> None:
    lab = Lab(servers, spool)
    for _ in range(3):
        lab.source.publish_status()
    assert [message.sequence for message in lab.messages("status")] == [1, 2, 3]
    assert [message.sequence for message in lab.messages("clock")] == [1, 2, 3]


async def test_queries_get_the_newest_status(servers: Servers, spool: Spool) -> None:
    lab = Lab(servers, spool)
    question = Question("status")
    assert decode((await lab.source.queries.answer(question)).payload).sequence == 0
    lab.source.publish_status()
    assert decode((await lab.source.queries.answer(question)).payload).sequence == 1


async def test_problems_with_the_status_are_logged_with_the_source(servers: Servers, spool: Spool) -> None:
    class RecordingPublisher(ToyPublisher):
        def publish(self, message: bytes) -> None:
            fields.append(current_log_fields())
            super().publish(message)

    class RecordingOutput(ToyOutput):
        def publisher(self, topic: Topic) -> ToyPublisher:
            super().publisher(topic)
            return RecordingPublisher(self, topic)

    fields: list[Mapping[str, str]] = []
    Lab(servers, spool, output=RecordingOutput()).source.publish_status()
    assert fields == [{"source": "lab"}, {"source": "lab"}]


async def test_the_status_describes_every_stream_and_output(servers: Servers, spool: Spool) -> None:
    lab = Lab(servers, spool, streams=TWO_STREAMS)
    lab.source.publish_status()
    [status] = lab.messages("status")
    assert (status.source, status.server) == ("lab", f"{HOST}:3020")
    assert [stream.components for stream in status.streams] == ["3d", "analog"]
    assert [output.name for output in status.outputs] == ["toy"]


@pytest.mark.parametrize("better", [0, 1])
async def test_the_clock_with_the_least_uncertainty_is_published(
    servers: Servers, spool: Spool, better: int
) -> None:
    lab = Lab(servers, spool, streams=TWO_STREAMS)
    for index, num_frames in ((better, 5000), (1 - better, 300)):
        for number in range(num_frames):
            delay_us = number * 7919 % 1000
            time_us = 10_000 * number
            lab.source.statuses[index].clock.observe(time_us, number, 10**15 + time_us + delay_us)
    clocks = [status.clock for status in lab.source.statuses]
    assert clocks[better].uncertainty_us < clocks[1 - better].uncertainty_us
    lab.source.publish_status()
    [message] = lab.messages("clock")
    assert message.components == ("3d", "analog")[better]
    assert message.clock.uncertainty_us == clocks[better].uncertainty_us


async def test_a_stream_without_a_clock_is_never_the_best(servers: Servers, spool: Spool) -> None:
    lab = Lab(servers, spool, streams=TWO_STREAMS)
    for number in range(300):
        lab.source.statuses[1].clock.observe(10_000 * number, number, 10**15 + 10_000 * number)
    lab.source.publish_status()
    [message] = lab.messages("clock")
    assert (message.components, bool(message.clock.has_clock)) == ("analog", True)


async def test_the_source_shows_streaming_while_any_stream_has_frames(servers: Servers, spool: Spool) -> None:
    lab = Lab(servers, spool, streams=TWO_STREAMS)
    async with running(lab):
        await lab.connected(2)
        assert True not in lab.output.streaming
        first, second = lab.server.connections
        first.send_frames(1)
        second.send(packet(3, b"\0\0\0\0"))  # a frame without components
        assert lab.output.streaming[-1] is True
        second.end()
        await settle()
        assert lab.output.streaming[-1] is True
        first.end()
        await settle()
        assert lab.output.streaming[-1] is False


async def test_a_source_that_replaces_another_continues_its_numbers(servers: Servers, spool: Spool) -> None:
    before = Lab(servers, spool, streams=TWO_STREAMS)
    before.source.sessions.newest = 5
    before.source.parameters_version = 7
    before.source.publish_status()
    after = Lab(servers, spool, before.source)
    assert [(each.session, each.parameters_version) for each in after.source.statuses] == [(5, 7)]
    after.source.publish_status()
    assert [message.sequence for message in after.messages("status")] == [2]


# Tasks ---------------------------------------------------------------------------------------


async def test_background_tasks_end_with_the_source(servers: Servers, spool: Spool) -> None:
    others = asyncio.all_tasks()
    lab = Lab(servers, spool)
    async with running(lab):
        await lab.connected()
        lab.threads.is_slow = True
        lab.server.connection.send(packet(5, b"a file"))
        await settle()
        assert lab.threads.num_waiting == 1
    await settle()
    assert asyncio.all_tasks() - others == set()


# C3D files -----------------------------------------------------------------------------------


async def test_a_file_is_stored_and_announced(servers: Servers, spool: Spool, tmp_path: Path) -> None:
    lab = Lab(servers, spool)
    async with running(lab):
        await lab.connected()
        lab.server.connection.send(packet(5, b"a file"))
        await settle()
        [(source, description)] = lab.files
        assert (source, description["bytes"]) == ("lab", 6)
        answer = await lab.source.queries.answer(Question("c3d"))
        assert (answer.payload, answer.attachment) == (b"a file", description)
    assert spool.newest("lab") == tmp_path / description["name"]


async def test_at_most_four_files_wait_for_the_disk(
    servers: Servers, spool: Spool, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab(servers, spool)
    async with running(lab):
        await lab.connected()
        lab.threads.is_slow = True
        for number in range(5):
            lab.server.connection.send(packet(5, bytes(number + 1)))
            await settle()
        [record] = [record for record in caplog.records if record.levelno == logging.ERROR]
        assert record.message == (
            f"{STREAM}: a C3D file of 5 bytes is dropped: 4 earlier files are still being written; "
            "is the disk slow, or the server faulty?"
        )
        lab.threads.is_slow = False
        lab.threads.finish()
        await settle()
        assert [description["bytes"] for _, description in lab.files] == [1, 2, 3, 4]
        lab.server.connection.send(packet(5, bytes(6)))  # there is room again
        await settle()
        assert lab.files[-1][1]["bytes"] == 6


async def test_files_that_cannot_be_stored_are_logged_and_make_room_for_others(
    servers: Servers, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    lab = Lab(servers, BrokenSpool(tmp_path, max_files=10, max_bytes=1000))
    async with running(lab):
        await lab.connected()
        for _ in range(6):
            lab.server.connection.send(packet(5, b"a file"))
            await settle()
    errors = [record.message for record in caplog.records if record.levelno == logging.ERROR]
    assert errors == [f"{STREAM}: 6 bytes from lab cannot be kept; check the disk"]
    [end] = [message for message in caplog.messages if "lost within" in message]
    assert end.endswith(" s: 6 messages (C3D file)")
    assert lab.files == []


async def test_a_missing_file_is_an_error_for_the_peer(
    servers: Servers, spool: Spool, tmp_path: Path
) -> None:
    lab = Lab(servers, spool)
    with pytest.raises(QueryError, match="has sent no C3D file so far") as caught:
        await lab.source.queries.answer(Question("c3d"))
    assert caught.value.code == "nothing-yet"
    (tmp_path / "lab-20260102T030405.000006Z.c3d").mkdir()
    with pytest.raises(QueryError, match=r"lab-.*\.c3d cannot be read") as caught:
        await lab.source.queries.answer(Question("c3d"))
    assert caught.value.code == "nothing-yet"


async def test_a_defect_in_a_task_of_the_source_is_an_error_and_streams_continue(
    servers: Servers, spool: Spool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab(servers, spool)
    monkeypatch.setattr(lab, "files", None)  # what takes the description of a file raises AttributeError
    async with running(lab):
        await lab.connected()
        lab.server.connection.send(packet(5, b"a file"))
        await settle()
        lab.threads.finish()
        await settle()
        assert len(lab.server.connections) == 1
    [error] = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert error.message.startswith("lab: defect in the gateway: AttributeError: ")
    assert error.exc_info is not None


# Recording -----------------------------------------------------------------------------------


async def test_recording_is_controlled_on_the_first_connection_that_works(
    servers: Servers, spool: Spool
) -> None:
    lab = Lab(servers, spool, streams=TWO_STREAMS, remote_control=True)
    start = Question("recording", set="start")
    with pytest.raises(QueryError, match="has no connection") as caught:
        await lab.source.queries.answer(start)
    assert caught.value.code == "no-connection"
    async with running(lab):
        await lab.connected(2)
        first, second = lab.server.connections
        await lab.source.queries.answer(start)
        assert (first.num_recording_packets, second.num_recording_packets) == (1, 0)
        first.end()
        await settle()
        answer = await lab.source.queries.answer(start)
        assert (first.num_recording_packets, second.num_recording_packets) == (1, 1)
        assert answer.payload == b'{"source":"lab","sent":"start"}'
