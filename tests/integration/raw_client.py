"""An RTC3D client made of nothing but a socket, and what it makes of frames."""

import asyncio
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from gateway.simulator.server import Simulator
from tests.unit.simulator.wire import (
    DATA,
    ByteOrder,
    Part,
    command,
    frame_of,
)

TIMEOUT_S = 20.0


class RawClient:
    """A client made of nothing but a socket."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    def send(self, *packets: bytes) -> None:
        self.writer.write(b"".join(packets))

    async def read(self) -> tuple[int, bytes]:
        """The next packet's type and body."""
        async with asyncio.timeout(TIMEOUT_S):
            size, packet_type = struct.unpack(">II", await self.reader.readexactly(8))
            return packet_type, await self.reader.readexactly(size - 8)

    async def ask(self, text: str) -> tuple[int, bytes]:
        self.send(command(text))
        return await self.read()

    async def frames(self, count: int, byte_order: ByteOrder = "big") -> list[list[Part]]:
        frames = []
        for _ in range(count):
            packet_type, body = await self.read()
            assert packet_type == DATA
            frames.append(frame_of(body, byte_order))
        return frames

    async def rest(self) -> bytes:
        """What still comes until the server closes the connection."""
        async with asyncio.timeout(TIMEOUT_S):
            return await self.reader.read()


@asynccontextmanager
async def connected(simulator: Simulator) -> AsyncIterator[RawClient]:
    reader, writer = await asyncio.open_connection("127.0.0.1", simulator.port)
    try:
        yield RawClient(reader, writer)
    finally:
        writer.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(TIMEOUT_S):
        while not condition():  # noqa: ASYNC110 - what is waited for here has no event
            await asyncio.sleep(0.005)


def numbers(frames: list[list[Part]]) -> list[int]:
    return [frame[0].frame_number for frame in frames]


def consecutive(frames: list[list[Part]]) -> bool:
    first = frames[0][0].frame_number
    return numbers(frames) == list(range(first, first + len(frames)))
