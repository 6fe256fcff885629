"""The hook between a client's connection and its socket, by which a program can change what passes."""

import asyncio
from typing import Protocol

from gateway.rtc3d.packets import Packet


class FilteredConnection(Protocol):
    """What a filter may use of its connection."""

    transport: asyncio.Transport
    number: int
    """Counts the connections since the server's start, from 1."""

    @property
    def name(self) -> str:
        """The client's address and port, for log messages."""
        ...

    def write(self, data: bytes) -> None:
        """Write bytes to the socket with one send, past the filter."""
        ...

    def handle(self, data: bytes) -> None:
        """Act on bytes from the client, past the filter; the replies go through it."""
        ...

    def answer(self, packet: Packet) -> list[bytes]:
        """Execute a client's packet; return the replies, each one packet."""
        ...

    def resume_reading(self) -> None:
        """Read from the socket again after ``transport.pause_reading``."""
        ...


class ConnectionFilter:
    """Passes one connection's bytes through unchanged.

    Subclasses override what they change, delay or drop. They reach the socket and the server only
    through ``connection``.
    """

    def __init__(self, connection: FilteredConnection) -> None:
        self.connection = connection

    def send(self, packet: bytes) -> None:
        """Send one packet (a reply or a data frame) to the client."""
        self.connection.write(packet)

    def receive(self, data: bytes) -> None:
        """Take bytes that were read from the client's socket."""
        self.connection.handle(data)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a client's packet; each of them then goes through ``send``."""
        return self.connection.answer(packet)

    def flush(self) -> None:
        """Write at once whatever the filter has kept back: the server is about to close the connection."""

    def connection_lost(self) -> None:
        """Discard whatever the filter has kept back, and cancel its timers: the connection has ended."""
