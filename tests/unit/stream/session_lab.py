"""One session with a scripted server, in virtual time."""

import asyncio
from typing import Any

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.rtc3d.commands import StreamFrames
from gateway.rtc3d.frames import Frame
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from tests.servers import packet
from tests.unit.stream.collected_files import CollectedFiles
from tests.unit.stream.scripted_server import Connection, ScriptedServer
from tests.virtual_time import EPOCH_UTIME, read_clocks

NO_DATA = packet(4)


class Lab:
    """A session and its server. ``frames`` and ``files`` are those that the session passed on.

    ``checks_s`` is when it asked for a check of the silence.
    """

    def __init__(self, components: tuple[str, ...] = ("3d",), **settings: Any) -> None:
        self.server = ScriptedServer()
        self.status = StreamStatus("3d", name="lab (3d)")
        self.frames: list[tuple[int, float]] = []
        self.files = CollectedFiles()
        self.checks_s: list[float] = []
        self.session = Session(
            SourceSettings(name="lab", host="192.0.2.20", **settings),
            StreamSettings.model_validate({"components": components}),
            self.status,
            self._on_frames,
            self.files,
            self.server.connect,
            read_clocks,
        )

    def _on_frames(self, frames: list[Frame], utime: int, steady_us: int) -> None:
        assert utime == EPOCH_UTIME + steady_us
        self.frames += [(frame.components[0].frame_number, steady_us / 1e6) for frame in frames]

    async def check_silence(self) -> None:
        self.checks_s.append(now_s())

    @property
    def connection(self) -> Connection:
        return self.server.connection

    async def streaming(self) -> None:
        """Connect and request frames."""
        await self.session.connect()
        await self.session.ask(StreamFrames())


@pytest.fixture
async def lab() -> Lab:
    return Lab()


def now_s() -> float:
    return asyncio.get_running_loop().time()
