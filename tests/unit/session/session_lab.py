"""One session with a scripted server, and what controls its stream, in virtual time."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.packets import FilePiece
from gateway.rtc3d.parameters_xml import ParsedParameters
from gateway.session.replies import Connection as ClientConnection
from gateway.session.session import Session
from gateway.session.status import StreamStatus
from gateway.session.stream_requests import StreamRequests, StreamTarget
from tests.support.clocks import EPOCH_UTIME, read_clocks
from tests.support.servers import packet
from tests.unit.session.scripted_server import Answer, Connection, ScriptedServer, obliging, read_parameters

NO_DATA = packet(4)


def now_s() -> float:
    return asyncio.get_running_loop().time()


class CollectedFiles:
    """``pieces`` are the contents of the pieces, ``interruptions`` the reasons why a connection ended."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.interruptions: list[str] = []

    def receive(self, piece: FilePiece) -> None:
        self.pieces.append(piece.body)

    def interrupt(self, reason: str) -> None:
        self.interruptions.append(reason)


class Lab:
    """``frames`` are the number and the time of arrival of those that the session passed on.

    ``checks_s`` is when it asked for a check of the silence, ``parameters`` what the control has read.
    ``step_s`` passes from one reading of the clock to the next, as if the work between them took it.
    """

    def __init__(self, answer: Answer = obliging, *, step_s: float = 0.0, **settings: Any) -> None:
        self.server = ScriptedServer(answer)
        self.status = StreamStatus("3d", name="lab (3d)")
        self.frames: list[tuple[int, float]] = []
        self.files = CollectedFiles()
        self.checks_s: list[float] = []
        self.parameters: list[ParsedParameters] = []
        self.has_subscribers = True
        self.has_defect = False
        self._step_us, self._readings = 1e6 * step_s, 0
        of_stream = {name: settings.pop(name) for name in StreamSettings.model_fields if name in settings}
        source = SourceSettings.model_validate({"name": "lab", "host": "192.0.2.20"} | settings)
        stream = StreamSettings.model_validate({"components": ["3d"]} | of_stream)
        common = source, stream, self.status
        self.session = Session(*common, self._on_frames, self.files, self.server.connect, self._read_clocks)
        self.control = StreamRequests(*common, self.session, self._read_parameters)
        self.changes = StreamTarget(*common, self.session, self.control, self._ask_for_subscribers)

    def _on_frames(self, frames: list[RawFrame], utime: int, steady_us: int) -> None:
        assert utime == EPOCH_UTIME + steady_us
        self.frames += [(frame.components[0].frame_number, steady_us / 1e6) for frame in frames]

    def _read_clocks(self) -> tuple[int, int]:
        self._readings += 1
        passed_us = round(self._step_us * self._readings)
        utime, steady_us = read_clocks()
        return utime + passed_us, steady_us + passed_us

    async def _read_parameters(self, connection: ClientConnection) -> ParsedParameters:
        self.parameters.append(await read_parameters(connection))
        return self.parameters[-1]

    def _ask_for_subscribers(self) -> bool:
        if self.has_defect:
            raise ZeroDivisionError
        return self.has_subscribers

    async def check_silence(self) -> None:
        self.checks_s.append(now_s())

    @property
    def numbers(self) -> list[int]:
        return [number for number, _ in self.frames]

    @property
    def connection(self) -> Connection:
        return self.server.connection

    @property
    def commands(self) -> list[str]:
        return self.connection.commands

    async def streaming(self, *numbers: int) -> None:
        """Connect, request frames and receive those with these numbers."""
        await self.session.connect()
        await self.session.ask(StreamFrames())
        self.connection.send_frames(*numbers)

    async def start(self) -> None:
        """Connect and do the handshake."""
        await self.session.connect()
        await self.control.start()

    @asynccontextmanager
    async def monitored(self, *, by_control: bool = False) -> AsyncIterator[asyncio.Task[None]]:
        """Monitor the session, and check the silence by its control if requested."""
        check = self.control.check_silence if by_control else self.check_silence
        task = asyncio.create_task(self.session.monitor(check))
        try:
            yield task
        finally:
            task.cancel()
