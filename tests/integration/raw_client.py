"""An RTC3D client that sends and receives bytes on a socket, and helpers for its frames."""

import asyncio
import socket
import struct
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Protocol

from tests.unit.session.server.wire import DATA, ByteOrder, WireComponent, command, components_in

TIMEOUT_S = 120.0


class RawClient:
    """A client without protocol logic."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    def send(self, *packets: bytes) -> None:
        self.writer.write(b"".join(packets))

    async def read(self) -> tuple[int, bytes]:
        """Return the next packet's type and body."""
        async with asyncio.timeout(TIMEOUT_S):
            size, packet_type = struct.unpack(">II", await self.reader.readexactly(8))
            return packet_type, await self.reader.readexactly(size - 8)

    async def ask(self, text: str) -> tuple[int, bytes]:
        self.send(command(text))
        return await self.read()

    async def frames(self, count: int, byte_order: ByteOrder = "big") -> list[list[WireComponent]]:
        frames = []
        for _ in range(count):
            packet_type, body = await self.read()
            assert packet_type == DATA
            frames.append(components_in(body, byte_order))
        return frames

    async def reply(self) -> tuple[int, bytes]:
        """Return the next packet that is not a data frame; discard the frames before it."""
        async with asyncio.timeout(TIMEOUT_S):
            while (packet := await self.read())[0] == DATA:
                pass
        return packet

    async def exactly(self, num_bytes: int) -> bytes:
        async with asyncio.timeout(TIMEOUT_S):
            return await self.reader.readexactly(num_bytes)

    async def rest(self) -> bytes:
        """Return all bytes until the server closes the connection."""
        async with asyncio.timeout(TIMEOUT_S):
            return await self.reader.read()

    def pause(self) -> None:
        """Read nothing more from the socket."""
        self.writer.transport.pause_reading()  # type: ignore[attr-defined] # a StreamWriter's is a Transport

    def resume(self) -> None:
        """Read again."""
        self.writer.transport.resume_reading()  # type: ignore[attr-defined] # as above

    def segments_received(self) -> int:
        """Return the number of TCP segments with data; at least one for each send, because Nagle is off."""
        data_segs_in = 152  # in struct tcp_info of linux/tcp.h
        info = self.writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
        return int.from_bytes(info[data_segs_in : data_segs_in + 4], sys.byteorder)


class Listening(Protocol):
    port: int


@asynccontextmanager
async def connected(server: Listening) -> AsyncIterator[RawClient]:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    try:
        yield RawClient(reader, writer)
    finally:
        writer.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(TIMEOUT_S):
        while not condition():  # noqa: ASYNC110 - the conditions have no event to wait for
            await asyncio.sleep(0.005)


def numbers(frames: list[list[WireComponent]]) -> list[int]:
    return [frame[0].frame_number for frame in frames]


def consecutive(frames: list[list[WireComponent]]) -> bool:
    first = frames[0][0].frame_number
    return numbers(frames) == list(range(first, first + len(frames)))
