"""The queries of one source, whose server is a fake that the test controls."""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest
import rtc3d

from gateway.config.settings import SourceSettings
from gateway.errors import QueryError
from gateway.messages.history import FoundMessages, MessageHistory, WantedMessages
from gateway.outputs.contract import Answer
from gateway.queries.answers import QueryHistory, ServerAnswer
from gateway.queries.questions import Question
from gateway.queries.server_requests import RecordingAccess, StreamAccess
from gateway.queries.service import SourceQueries
from gateway.rtc3d.commands import Command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketType
from gateway.session.status import SessionNumbers, StreamStatus
from tests.support.parameters import in_root
from tests.support.waiting import wait_until_async


def parameters_xml(unit: str, frames_sent: int = 1) -> bytes:
    return in_root(
        f"<General><Server><Stats><FramesSent>{frames_sent}</FramesSent></Stats></Server></General>",
        f"<The_3D><Unit>{unit}</Unit></The_3D>",
    )


MM, CM = parameters_xml("mm"), parameters_xml("cm")


class FakeServer:
    """Receives commands. Those in ``replies`` are answered at once, others one by one with ``answer``."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.replies: dict[str, bytes | Packet | Exception] = {}
        self.unanswered: deque[asyncio.Future[Packet]] = deque()
        self.is_connected = True

    async def send(self, command: Command) -> Packet:
        self.commands.append(str(command))
        reply = self.replies.get(str(command))
        match reply:
            case None:
                future: asyncio.Future[Packet] = asyncio.get_running_loop().create_future()
                self.unanswered.append(future)
                return await future
            case bytes():
                return Packet(PacketType.XML, reply)
            case Packet():
                return reply
        raise reply

    def answer(self, xml: bytes) -> None:
        """Answer the oldest command that has no reply yet."""
        self.unanswered.popleft().set_result(Packet(PacketType.XML, xml))

    async def wait_for_commands(self, count: int) -> None:
        await wait_until_async(lambda: len(self.commands) >= count)


class FakeConnection:
    """One connection of a stream with the server."""

    def __init__(self, server: FakeServer) -> None:
        self._server = server
        self.is_open = True

    async def ask(self, command: Command) -> Packet:
        return await self._server.send(command)


class FakeSource:
    """A source "lab" with a stream of 3D and 6D, in session 1; ``settings`` replace its defaults.

    With ``two_streams``, it has another one of analog channels, which is not connected.
    """

    def __init__(self, *, two_streams: bool = False, **settings: Any) -> None:
        self.server = FakeServer()
        sessions = SessionNumbers()
        self.status = StreamStatus("3d 6d", sessions=sessions)
        self.second_status = StreamStatus("analog", sessions=sessions)
        self.newest_messages: dict[ComponentType, bytes] = {}
        self.history = MessageHistory()
        """What the source has published."""
        self.announced: list[tuple[bytes | None, int]] = []
        """The XML of all announced parameters, None if they are void, with their version."""
        self.num_file_reads = 0
        self.recorded: list[bool] = []
        self.on_recorded: Callable[[bool], None] = lambda _: None
        self.followed: list[tuple[bool, str]] = []
        self.disk = asyncio.Event()
        """Whether the disk of the takes that follow responds."""
        self.disk.set()
        # The configuration does not accept 0. It sends every fresh query to the server.
        source_settings = SourceSettings(name="lab", host="192.0.2.1").model_copy(
            update={"fresh_interval_s": 0.0} | settings
        )
        self.connection = FakeConnection(self.server)
        self.second_connection: FakeConnection | None = None
        self._has_two_streams = two_streams
        self.query_history = QueryHistory("lab")
        self.queries = SourceQueries(
            source_settings,
            lambda: self.streams,
            self,
            rtc3d.status_t().encode,
            self._last_c3d,
            RecordingAccess(self._record, self._follow_recording),
            self._announce,
            self.query_history,
        )
        self.status.connected("the server")

    def newest(self, component: ComponentType, _output: str) -> bytes | None:
        return self.newest_messages.get(component)

    async def find(self, key: str, _output: str, wanted: WantedMessages) -> FoundMessages | None:
        return self.history.find(key, wanted)

    @property
    def history_overview(self) -> dict[str, Any]:
        return self.history.overview

    @property
    def streams(self) -> list[StreamAccess]:
        """The streams at present."""
        first = StreamAccess(
            (ComponentType.MARKERS, ComponentType.TOOLS), self.status, self._ready(self.connection)
        )
        second = StreamAccess(
            (ComponentType.ANALOG,), self.second_status, self._ready(self.second_connection)
        )
        return [first, second] if self._has_two_streams else [first]

    def _ready(self, connection: FakeConnection | None) -> FakeConnection | None:
        return connection if self.server.is_connected and connection and connection.is_open else None

    async def _announce(self, answer: ServerAnswer | None, version: int) -> None:
        self.announced.append((None if answer is None else answer.xml, version))
        for status in (self.status, self.second_status):
            status.parameters_version = version

    async def _last_c3d(self) -> Answer:
        self.num_file_reads += 1
        await asyncio.sleep(0)
        return Answer(b"file", "application/octet-stream")

    def _record(self, start: bool) -> bool:
        self.recorded.append(start)
        self.on_recorded(start)
        return self.server.is_connected

    async def _follow_recording(self, start: bool, name: str) -> dict[str, Any]:
        self.followed.append((start, name))
        await self.disk.wait()
        return {"take": name} if start else {}

    def disconnect(self) -> None:
        """Lose the connection of the first stream."""
        self.connection.is_open = False

    async def connect(self, reply: bytes | Exception | None) -> None:
        """Connect the first stream again.

        In the handshake, SendParameters gets this reply, or it is answered later. Raises an exception.
        """
        self.disconnect()
        self.status.connected("the server")
        self.connection = FakeConnection(self.server)
        await self._do_handshake(self.connection, reply)

    async def connect_second(self, reply: bytes | Exception | None) -> None:
        """Connect the second stream, like ``connect``."""
        self.second_status.connected("the server")
        self.second_connection = FakeConnection(self.server)
        await self._do_handshake(self.second_connection, reply)

    async def _do_handshake(self, connection: FakeConnection, reply: bytes | Exception | None) -> None:
        if reply is None:
            self.server.replies.pop("SendParameters", None)
        else:
            self.server.replies["SendParameters"] = reply
        await self.queries.parameters.read_for_handshake(connection)

    async def store_parameters(self, xml: bytes) -> None:
        """Read all parameters, as at the start of the first connection."""
        await self._do_handshake(self.connection, xml)
        self.server.commands.clear()

    async def refresh(self, xml: bytes | Exception | None = None) -> None:
        """Read all parameters again; with ``xml``, the server answers with it from now on."""
        if xml is not None:
            self.server.replies["SendParameters"] = xml
        await self.queries.parameters.refresh()

    async def parameters(self, *sections: str, fresh: bool = False, stale_ok: bool = False) -> ServerAnswer:
        return await self.queries.parameters.get(sections, fresh=fresh, stale_ok=stale_ok)

    async def parameters_error(self, *sections: str, **options: bool) -> QueryError:
        with pytest.raises(QueryError) as caught:
            await self.parameters(*sections, **options)
        return caught.value

    async def answer(self, kind: Any, name: str = "", **question: Any) -> Answer:
        return await self.queries.answer(Question(kind, name, **question), "zenoh")
