"""Scripted RT servers, for the deviations in the field notes that the simulator does not have."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Self


def packet(packet_type: int, body: bytes | str = b"") -> bytes:
    data = body.encode() if isinstance(body, str) else body
    return struct.pack(">II", 8 + len(data), packet_type) + data


def c3d_file(content: bytes = b"", num_bytes: int = 1024) -> bytes:
    """Return a file that begins like a C3D file, and ends with ``content``."""
    return b"\x02\x50" + bytes(num_bytes - 2 - len(content)) + content


def ok(text: str) -> bytes:
    return packet(1, text)


def error(text: str) -> bytes:
    return packet(0, text)


def markers_frame(number: int, *positions: tuple[float, float, float], order: str = ">") -> bytes:
    """Return a type-3 packet with one 3D component: frame ``number``, its time stamp ``number`` ms."""
    items = b"".join(struct.pack(order + "4f", *position, 0.1) for position in positions)
    component = (
        struct.pack(order + "IIiqI", 24 + len(items), 1, number, 1000 * number, len(positions)) + items
    )
    return packet(3, struct.pack(order + "I", 1) + component)


Script = Callable[["Client"], Awaitable[None]]


class Client:
    """The server's side of one connection, for a script."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    async def command(self) -> str:
        """Return the text of the next command; raises IncompleteReadError if the client disconnects."""
        packet_type, body = await self.packet()
        assert packet_type == 1
        return body.decode("ascii")

    async def packet(self) -> tuple[int, bytes]:
        """Return the type and body of the next packet; raises as ``command`` does."""
        size, packet_type = struct.unpack(">II", await self._reader.readexactly(8))
        return packet_type, await self._reader.readexactly(size - 8)

    def send(self, data: bytes) -> None:
        """Send bytes; raises ConnectionError after the end of the connection (uvloop: RuntimeError)."""
        if self._writer.is_closing():
            raise ConnectionResetError("the connection is closed")
        self._writer.write(data)

    async def drain(self) -> None:
        """Wait until the client has taken most of what was sent; raises ConnectionError if it disconnects."""
        await self._writer.drain()
        await asyncio.sleep(0)  # while there is room, drain returns without letting other tasks run

    async def commands(self, answer: Callable[[str], bytes | None]) -> None:
        """Send what ``answer`` returns for each command, until the client disconnects."""
        while True:
            reply = answer(await self.command())
            if reply is not None:
                self.send(reply)

    def end(self) -> None:
        """Send the end of the stream, and leave the other direction open."""
        self._writer.write_eof()

    def cut(self) -> None:
        """Abort the connection."""
        self._writer.transport.abort()

    def reset(self) -> None:
        """Abort the connection with a RST."""
        linger = struct.pack("ii", 1, 0)
        self._writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self.cut()


class ScriptedServer:
    """Runs ``script`` for every connection; listens on a free port if ``port`` is 0."""

    def __init__(self, script: Script, port: int = 0) -> None:
        self._script = script
        self.port = port
        self.connections = 0
        self._scripts: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.close()
        for task, writer in self._scripts.items():
            writer.transport.abort()
            task.cancel()
        await self._server.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        task = asyncio.current_task()
        assert task is not None
        self._scripts[task] = writer
        # asyncio would log a task that ends as cancelled.
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            await self._script(Client(reader, writer))
        writer.close()
        del self._scripts[task]
