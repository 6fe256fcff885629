"""Scripted RT servers, for what the simulator does not have: the field notes, and tools that tests move."""

import asyncio
import contextlib
import socket
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from gateway.rtc3d.components import ITEM_DTYPES, MISSING, ComponentType, encode_component
from gateway.rtc3d.frames import encode_frame
from gateway.rtc3d.parameters import Parameters, Parameters3D, Parameters6D, Tool
from gateway.rtc3d.parameters_xml import encode_parameters


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

    def __init__(self, script: Script, port: int = 0, host: str = "127.0.0.1") -> None:
        self._script = script
        self._host = host
        self.port = port
        self.connections = 0
        self._scripts: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, self._host, self.port)
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


PERIOD_S = 0.01


class ToolServer(ScriptedServer):
    """Sends frames of its ``tools`` at 100 Hz: (q0, qx, qy, qz, x, y, z, error) each, None if out of view."""

    def __init__(self, labels: Sequence[str], unit: str = "mm") -> None:
        super().__init__(self._run)
        self.labels = list(labels)
        self.unit = unit
        self.tools: list[Sequence[float] | None] = [
            (1.0, 0.0, 0.0, 0.0, 1000.0 * number, 500.0, -250.0, 0.5) for number in range(len(labels))
        ]

    @property
    def xml(self) -> bytes:
        parameters = Parameters(
            markers=Parameters3D(100.0, self.unit),
            tools=Parameters6D(100.0, tuple(Tool(str(id_), label) for id_, label in enumerate(self.labels))),
        )
        return encode_parameters(parameters)

    async def _run(self, client: Client) -> None:
        sending: list[asyncio.Task[None]] = []

        def answer(command: str) -> bytes:
            if command.startswith("SendParameters"):
                return packet(2, self.xml)
            if command.startswith("StreamFrames") and command != "StreamFrames Stop":
                sending.append(asyncio.create_task(self._send_frames(client)))
            return ok(f"OK-{command}")

        try:
            await client.commands(answer)
        finally:
            for task in sending:
                task.cancel()

    async def _send_frames(self, client: Client) -> None:
        started_s = time.monotonic()
        number = 0
        while True:
            await asyncio.sleep(max(0.0, started_s + number * PERIOD_S - time.monotonic()))
            number += 1
            client.send(packet(3, self._frame(number)))
            await client.drain()

    def _frame(self, number: int) -> bytes:
        items: Any = np.empty(len(self.tools), ITEM_DTYPES[ComponentType.TOOLS])
        for index, tool in enumerate(self.tools):
            items[index] = (MISSING,) * 8 if tool is None else tuple(tool)
        time_us = round(number * PERIOD_S * 1e6)
        return encode_frame([encode_component(ComponentType.TOOLS, number, time_us, items)])
