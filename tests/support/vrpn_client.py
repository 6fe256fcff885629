"""A VRPN client for tests, written without the gateway's protocol module."""

import asyncio
import contextlib
import socket
import struct
from typing import NamedTuple, Self

COOKIE = b"vrpn: ver. 07.35  0" + bytes(5)
PING_TYPE = 5


class Pose(NamedTuple):
    """A pose as it arrived: the tracker's name, its time in µs, and x, y, z, qx, qy, qz, qw."""

    name: str
    utime: int
    sensor: int
    values: tuple[float, ...]


def message(number: int, message_type: int, body: bytes = b"") -> bytes:
    header = struct.pack(">IIIiiI", 24 + len(body), 0, 0, number, message_type, 0)
    return header + body + bytes(-len(body) % 8)


def description(number: int, message_type: int, name: str) -> bytes:
    encoded = name.encode() + b"\0"
    return message(number, message_type, struct.pack(">I", len(encoded)) + encoded)


class VrpnClient:
    """Reads everything that a server sends, from ``connect`` or ``request_callback`` on."""

    def __init__(self) -> None:
        self.cookie = b""
        self.trackers: dict[int, str] = {}
        """The names of the senders by number, as described last."""
        self.types: dict[int, str] = {}
        self.poses: list[Pose] = []
        self.pongs: list[str] = []
        self.described: list[str] = []
        """The names in the order of their descriptions."""
        self.has_ended = False
        self._reading: asyncio.Task[None] | None = None
        self.writer: asyncio.StreamWriter

    @classmethod
    async def connect(cls, port: int, begin: bytes = COOKIE) -> Self:
        """Connect over TCP and send ``begin``."""
        client = cls()
        await client._start(*await asyncio.open_connection("127.0.0.1", port), begin)
        return client

    @classmethod
    async def request_callback(cls, port: int, host_in_message: str = "127.0.0.1") -> Self:
        """Ask by UDP, once, and wait to be called back."""
        client = cls()
        called: asyncio.Future[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = (
            asyncio.get_running_loop().create_future()
        )

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            called.set_result((reader, writer))

        server = await asyncio.start_server(accept, "127.0.0.1", 0)
        own_port = server.sockets[0].getsockname()[1]
        send_datagram(f"{host_in_message} {own_port}\0".encode(), port)
        await client._start(*await asyncio.wait_for(called, 10), COOKIE)
        server.close()
        return client

    async def _start(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, begin: bytes) -> None:
        self.writer = writer
        writer.write(begin)
        self._reading = asyncio.create_task(self._read(reader))

    def describe(self, *names: str) -> None:
        """Describe the type ping, and senders 0, 1, … to the server."""
        self.writer.write(description(PING_TYPE, -2, "vrpn_Base ping_message"))
        for number, name in enumerate(names):
            self.writer.write(description(number, -1, name))

    def ping(self, number: int) -> None:
        self.writer.write(message(number, PING_TYPE))

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            self.cookie = await reader.readexactly(24)
            while True:
                length, seconds, microseconds, sender, message_type, _ = struct.unpack(
                    ">IIIiiI", await reader.readexactly(24)
                )
                padded = await reader.readexactly(-(-(length - 24) // 8) * 8)
                self._receive(sender, message_type, seconds * 10**6 + microseconds, padded[: length - 24])
        self.has_ended = True

    def _receive(self, sender: int, message_type: int, utime: int, body: bytes) -> None:
        if message_type < 0:
            (length,) = struct.unpack_from(">I", body)
            assert len(body) == 4 + length <= 100
            assert body[-1] == 0
            name = body[4:-1].decode()
            (self.trackers if message_type == -1 else self.types)[sender] = name
            if message_type == -1:
                self.described.append(name)
        elif self.types[message_type] == "vrpn_Tracker Pos_Quat":
            sensor, _, *values = struct.unpack(">ii7d", body)
            self.poses.append(Pose(self.trackers[sender], utime, sensor, tuple(values)))
        elif self.types[message_type] == "vrpn_Base pong_message":
            self.pongs.append(self.trackers[sender])

    async def close(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
        self.writer.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


def send_datagram(datagram: bytes, port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.sendto(datagram, ("127.0.0.1", port))
