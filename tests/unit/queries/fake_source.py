"""The queries of one source, whose server is a fake that the test controls."""

import asyncio
from collections import deque
from typing import Any

import pytest
import rtc3d

from gateway.config.settings import SourceSettings
from gateway.errors import QueryError
from gateway.outputs.contract import Answer
from gateway.queries.parameter_cache import CachedParameters
from gateway.queries.questions import Question
from gateway.queries.server_requests import StreamAccess
from gateway.queries.source_queries import SourceQueries
from gateway.rtc3d.commands import Command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.stream.status import StreamStatus
from tests.spec_parameters import in_root
from tests.waiting import wait_until_async


def parameters_xml(unit: str, frames_sent: int = 1) -> bytes:
    return in_root(
        f"<General><Server><Stats><FramesSent>{frames_sent}</FramesSent></Stats></Server></General>",
        f"<The_3D><Unit>{unit}</Unit></The_3D>",
    )


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


class FakeSource:
    """A source "lab" with one stream of 3D and 6D, in session 1; ``settings`` replace its defaults."""

    def __init__(self, **settings: Any) -> None:
        self.server = FakeServer()
        self.status = StreamStatus("3d 6d", session=1)
        self.newest_messages: dict[ComponentType, bytes] = {}
        self.changes: list[bytes] = []
        """The XML of each reported change of the parameters."""
        self.num_file_reads = 0
        self.recorded: list[bool] = []
        # The configuration does not accept 0. It sends every fresh query to the server.
        source_settings = SourceSettings(name="lab", host="192.0.2.1").model_copy(
            update={"fresh_interval_s": 0.0} | settings
        )
        self.stream = StreamAccess(
            (ComponentType.MARKERS, ComponentType.TOOLS),
            self.status,
            lambda: self.server.send if self.server.is_connected else None,
        )
        self.queries = SourceQueries(
            source_settings,
            lambda: [self.stream],
            lambda component, _output: self.newest_messages.get(component),
            rtc3d.status_t().encode,
            self._last_c3d,
            self._record,
            lambda xml, _parsed: self.changes.append(xml),
        )

    async def _last_c3d(self) -> Answer:
        self.num_file_reads += 1
        await asyncio.sleep(0)
        return Answer(b"file", "application/octet-stream")

    def _record(self, start: bool) -> bool:
        self.recorded.append(start)
        return self.server.is_connected

    def store_parameters(self, xml: bytes) -> None:
        """Store all parameters, as at the start of a connection."""
        self.queries.parameters.store(xml, parse_parameters(xml))

    async def parameters(
        self, *sections: str, fresh: bool = False, stale_ok: bool = False
    ) -> CachedParameters:
        return await self.queries.parameters.get(sections, fresh=fresh, stale_ok=stale_ok)

    async def parameters_error(self, *sections: str, **options: bool) -> QueryError:
        with pytest.raises(QueryError) as caught:
            await self.parameters(*sections, **options)
        return caught.value

    async def answer(self, kind: Any, name: str = "", **question: Any) -> Answer:
        return await self.queries.answer(Question(kind, name, **question), "zenoh")
