"""A queries before a server whose every answer the test decides."""

import asyncio
from collections import deque
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.errors import QueryError
from gateway.outputs.contract import Answer
from gateway.queries.parameter_cache import CachedParameters
from gateway.queries.questions import Question
from gateway.queries.source_queries import SourceQueries, StreamAccess
from gateway.rtc3d.commands import Command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, PacketType
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.stream.status import StreamStatus
from tests.spec_parameters import in_root
from tests.waiting import wait_until_async


def xml_of(unit: str, frames_sent: int = 1) -> bytes:
    return in_root(
        f"<General><Server><Stats><FramesSent>{frames_sent}</FramesSent></Stats></Server></General>",
        f"<The_3D><Unit>{unit}</Unit></The_3D>",
    )


class Server:
    """Takes commands and lets the test answer them: by ``replies``, or one by one by ``answer``."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.replies: dict[str, bytes | Packet | Exception] = {}
        self.waiting: deque[asyncio.Future[Packet]] = deque()
        self.connected = True

    async def ask(self, command: Command) -> Packet:
        self.commands.append(str(command))
        reply = self.replies.get(str(command))
        match reply:
            case None:
                future: asyncio.Future[Packet] = asyncio.get_running_loop().create_future()
                self.waiting.append(future)
                return await future
            case bytes():
                return Packet(PacketType.XML, reply)
            case Packet():
                return reply
        raise reply

    def answer(self, xml: bytes) -> None:
        self.waiting.popleft().set_result(Packet(PacketType.XML, xml))


class Rig:
    """A queries with one stream."""

    def __init__(self, **source: Any) -> None:
        self.server = Server()
        self.status = StreamStatus("3d 6d", session=1)
        self.newest: dict[ComponentType, bytes] = {}
        self.changes: list[bytes] = []
        self.files: list[str] = []
        self.recorded: list[bool] = []
        # An interval of 0 cannot be configured: here every fresh question is one.
        settings = SourceSettings(name="lab", host="192.0.2.1").model_copy(
            update={"fresh_interval_s": 0.0} | source
        )
        self.queries = SourceQueries(
            settings,
            [
                StreamAccess(
                    (ComponentType.MARKERS, ComponentType.TOOLS),
                    self.status,
                    lambda: self.server.ask if self.server.connected else None,
                )
            ],
            lambda: self.newest,
            lambda: b"",
            self._last_c3d,
            self._record,
            lambda xml, _parsed: self.changes.append(xml),
        )

    async def _last_c3d(self) -> Answer:
        self.files.append("read")
        await asyncio.sleep(0)
        return Answer(b"file", "application/octet-stream")

    def _record(self, start: bool) -> bool:
        self.recorded.append(start)
        return self.server.connected

    def learn(self, xml: bytes) -> None:
        self.queries.cache_parameters(xml, parse_parameters(xml))

    async def parameters(
        self, *sections: str, fresh: bool = False, stale_ok: bool = False
    ) -> CachedParameters:
        return await self.queries.parameters(sections, fresh=fresh, stale_ok=stale_ok)

    async def ask(self, kind: Any, name: str = "", **question: Any) -> Answer:
        return await self.queries.answer(Question(kind, name, **question))

    async def error(self, *sections: str, **options: bool) -> QueryError:
        with pytest.raises(QueryError) as caught:
            await self.parameters(*sections, **options)
        return caught.value

    async def asked(self, count: int) -> None:
        await wait_until_async(lambda: len(self.server.commands) >= count)
