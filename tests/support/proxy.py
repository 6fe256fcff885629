"""A TCP proxy that disturbs connections between a client and a server, in either direction.

Modelled on TCPFuzzingProxy of asyncpg.
"""

import asyncio
import contextlib
import random
import socket
import struct
from types import TracebackType
from typing import Self

_READ_BYTES = 16 * 1024


class Direction:
    """One direction of all connections through the proxy. Changes apply to the next bytes."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._open = asyncio.Event()
        self._open.set()
        self.passed_bytes = 0
        self.segment_bytes: int | None = None
        """The maximum number of bytes in one write; None for no limit."""
        self.bytes_per_s: float | None = None
        """The maximum rate of reading. The proxy has no buffer, so the buffers of the sender fill."""
        self.corrupt_share = 0.0
        """The share of bytes to change, chosen at random."""

    def stall(self) -> None:
        """Pass nothing until ``resume``; connections stay open."""
        self._open.clear()

    def resume(self) -> None:
        self._open.set()

    def clear(self) -> None:
        """Pass everything at once and unchanged."""
        self.corrupt_share = 0.0
        self.segment_bytes = self.bytes_per_s = None
        self.resume()

    @property
    def read_bytes(self) -> int:
        """The maximum number of bytes in one read."""
        if self.bytes_per_s is None:
            return _READ_BYTES
        return max(1, min(_READ_BYTES, int(self.bytes_per_s / 50)))

    async def send(self, data: bytes, writer: asyncio.StreamWriter) -> None:
        if self.bytes_per_s is not None:
            await asyncio.sleep(len(data) / self.bytes_per_s)
        await self._open.wait()
        data = self._corrupted(data)
        size = self.segment_bytes or max(1, len(data))
        for start in range(0, len(data), size):
            if writer.is_closing():
                return
            segment = data[start : start + size]
            self.passed_bytes += len(segment)
            writer.write(segment)
            await writer.drain()
            if self.segment_bytes is not None:
                await asyncio.sleep(0)  # so that the receiver reads each segment by itself

    def _corrupted(self, data: bytes) -> bytes:
        if not self.corrupt_share:
            return data
        return bytes(
            byte ^ self._random.randint(1, 255) if self._random.random() < self.corrupt_share else byte
            for byte in data
        )


class FuzzingProxy:
    """Forwards connections from ``port`` to ``server_port`` of this host."""

    port: int

    def __init__(self, server_port: int) -> None:
        self._server_port = server_port
        self.to_client = Direction(seed=1)
        self.to_server = Direction(seed=2)
        self._connections: set[_Connection] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.close()
        self.cut(reset=True)
        if self._tasks:
            await asyncio.wait(self._tasks)

    @property
    def num_connections(self) -> int:
        """How many clients the proxy has connected to the server."""
        return len(self._connections)

    def cut(self, *, reset: bool = False) -> None:
        """Close all connections between two bytes: with FIN after all sent bytes, or with RST."""
        for connection in list(self._connections):
            connection.end(reset=reset)

    def cut_after(self, num_bytes: int) -> None:
        """Close each connection after ``num_bytes`` more bytes to its client, for example within a packet."""
        for connection in self._connections:
            connection.bytes_left = num_bytes

    def clear(self) -> None:
        """Remove all disturbances in both directions."""
        self.to_client.clear()
        self.to_server.clear()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        try:
            server = await asyncio.open_connection("127.0.0.1", self._server_port, limit=_READ_BYTES)
        except OSError:
            writer.transport.abort()
            return
        connection = _Connection((reader, writer), server)
        self._connections.add(connection)
        try:
            await connection.run(self.to_client, self.to_server)
        finally:
            self._connections.discard(connection)


_Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class _Connection:
    """The connection of one client, and the connection to the server for it."""

    def __init__(self, client: _Streams, server: _Streams) -> None:
        self._client = client
        self._server = server
        self._is_over = asyncio.Event()
        self.bytes_left: int | None = None

    async def run(self, to_client: Direction, to_server: Direction) -> None:
        pumps = [
            asyncio.create_task(self._pump(self._server[0], self._client[1], to_client, cuts=True)),
            asyncio.create_task(self._pump(self._client[0], self._server[1], to_server)),
        ]
        try:
            await self._is_over.wait()
        finally:
            self.end()
            for pump in pumps:
                pump.cancel()
            await asyncio.wait(pumps)

    def end(self, *, reset: bool = False) -> None:
        for _, writer in (self._client, self._server):
            if reset:
                if not writer.is_closing():  # otherwise its socket may be closed already
                    tcp = writer.get_extra_info("socket")
                    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                writer.transport.abort()
            else:
                writer.close()
        self._is_over.set()

    async def _pump(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        direction: Direction,
        *,
        cuts: bool = False,
    ) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(direction.read_bytes):
                if cuts and self.bytes_left is not None:
                    data = data[: self.bytes_left]
                    self.bytes_left -= len(data)
                await direction.send(data, writer)
                if cuts and self.bytes_left == 0:
                    break
        self._is_over.set()
