"""The hook between a client's connection and its socket, where a program can change the bytes."""

import asyncio
from typing import Protocol

from gateway.rtc3d.packets import Packet


class FilteredConnection(Protocol):
    """What a filter may use of its connection."""

    transport: asyncio.Transport
    number: int
    """The connection's number since the server's start, from 1."""

    @property
    def name(self) -> str:
        """The client's address and port, for log messages."""
        ...

    def write(self, data: bytes) -> None:
        """Write bytes to the socket with one send, bypassing the filter."""
        ...

    def handle(self, data: bytes) -> None:
        """Process bytes from the client, bypassing the filter; the replies go through it."""
        ...

    def answer(self, packet: Packet) -> list[bytes]:
        """Execute a client's packet; return the replies, each one packet."""
        ...

    def resume_reading(self) -> None:
        """Read from the socket again after ``transport.pause_reading``."""
        ...

    def hold_commands(self) -> None:
        """Answer no further packets until ``continue_commands``."""
        ...

    def continue_commands(self) -> None:
        """Answer packets again."""
        ...

    def continue_sending(self) -> None:
        """Send frames and replies again after ``is_busy``; the frames in between are dropped."""
        ...


class ConnectionFilter:
    """Passes one connection's bytes through unchanged.

    Subclasses override methods to change, delay or drop them. They reach the socket and the server only
    through ``connection``.
    """

    is_busy: bool = False
    """Whether no frame and no reply may be sent now. Frames are dropped, commands wait."""

    def __init__(self, connection: FilteredConnection) -> None:
        self.connection = connection

    def send(self, packet: bytes) -> None:
        """Send one packet (a reply or a data frame) to the client."""
        self.connection.write(packet)

    def receive(self, data: bytes) -> None:
        """Process bytes that were read from the client's socket."""
        self.connection.handle(data)

    def answer(self, packet: Packet) -> list[bytes]:
        """Return the replies to a client's packet; each of them then goes through ``send``."""
        return self.connection.answer(packet)

    def flush(self) -> None:
        """Write at once all bytes that the filter holds back: the server is about to close the connection."""

    def connection_lost(self) -> None:
        """Discard all bytes that the filter holds back, and cancel its timers: the connection has ended."""
