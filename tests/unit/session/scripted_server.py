"""An RT server without sockets: tests pass its ``connect`` to a Session or a Supervisor."""

import asyncio
import struct
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from gateway.config.settings import SourceSettings
from gateway.errors import ConnectError
from gateway.rtc3d.commands import SendParameters
from gateway.rtc3d.parameters_xml import ParsedParameters, parse_parameters
from gateway.session.replies import Connection as ClientConnection
from gateway.session.session import Session
from tests.support.servers import markers_frame, ok, packet

XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D/></RT_Parameters>")

BROKEN_FRAME = packet(3, struct.pack(">III", 1, 80, 1))
"""A frame whose only component announces more bytes than follow."""

Answer = Callable[[str], bytes | None]
"""Returns the packets that answer a command, or None to ignore it."""


def obliging(command: str) -> bytes:
    """Accept every command."""
    return XML if command.startswith("SendParameters") else ok(f"OK-{command}")


def refusing(*refused: str, by: Answer = obliging) -> Answer:
    """Return an answer that refuses the commands that begin with one of these texts."""

    def answer(command: str) -> bytes | None:
        return packet(0, f"Error-{command}") if command.startswith(refused) else by(command)

    return answer


def refusing_without_name(*refused: str, by: Answer = obliging) -> Answer:
    """Return an answer that refuses as ``refusing`` does, and does not say what (field note 20)."""
    return lambda command: packet(0, "what?") if command.startswith(refused) else by(command)


def silent_to(*ignored: str, by: Answer = obliging) -> Answer:
    """Return an answer that ignores the commands that begin with one of these texts."""
    return lambda command: None if command.startswith(ignored) else by(command)


async def read_parameters(client: ClientConnection) -> ParsedParameters:
    """Ask for the parameters, as in a handshake."""
    packet = await client.ask(SendParameters())
    return parse_parameters(packet.body)


class Connection(asyncio.Transport):
    """One connection: the client's transport, and what the server does on it."""

    def __init__(self, server: "ScriptedServer", session: Session) -> None:
        super().__init__()
        self._server = server
        self._session = session
        self.commands: list[str] = []
        self.is_open = True
        self.is_read = True
        """Whether the client reads from the connection."""
        self.got_eof = False
        self.num_recording_packets = 0

    @property
    def number(self) -> int:
        """Its number, from 1, among those that are open."""
        return [each for each in self._server.connections if each.is_open].index(self) + 1

    # The client's side.

    def get_extra_info(self, name: str, default: Any = None) -> Any:  # noqa: ARG002 - asyncio's signature
        return SimpleNamespace(setsockopt=lambda *_: None)

    def write(self, data: Any) -> None:
        assert self.is_open, "uvloop raises if a closed transport is written to"
        while data:
            size, packet_type = struct.unpack_from(">II", data)
            if packet_type == 1:
                self._on_command(data[8:size].decode("ascii"))
            elif packet_type == 3:  # field note 16
                self.num_recording_packets += 1
            data = data[size:]

    def write_eof(self) -> None:
        self.got_eof = True
        if self._server.closes_at_bye:
            self.end()

    def abort(self) -> None:
        self.end()

    def is_closing(self) -> bool:
        return not self.is_open

    def pause_reading(self) -> None:
        assert self.is_read
        self.is_read = False

    def resume_reading(self) -> None:
        assert not self.is_read
        self.is_read = True

    # The server's side.

    def _on_command(self, command: str) -> None:
        self.commands.append(command)
        answer = self._server.answer_on(self, command)
        if answer is not None:
            asyncio.get_running_loop().call_soon(self.send, answer)

    def send(self, data: bytes) -> None:
        """Send bytes to the client, in one read."""
        if self.is_open:
            self._session.data_received(data)

    def send_frames(self, *numbers: int) -> None:
        """Send frames of one marker with these numbers, in one read."""
        self.send(b"".join(markers_frame(number, (0.0, 0.0, 0.0)) for number in numbers))

    def end(self, error: Exception | None = None) -> None:
        """Close the connection, or break it with ``error``."""
        if self.is_open:
            self.is_open = False
            asyncio.get_running_loop().call_soon(self._session.connection_lost, error)


class ScriptedServer:
    """A server that answers each command with ``answer``; if ``refuses`` is set, it refuses connections.

    ``answer_on`` may answer depending on the connection instead.
    """

    def __init__(self, answer: Answer = obliging) -> None:
        self.answer = answer
        self.answer_on: Callable[[Connection, str], bytes | None] = lambda _, command: self.answer(command)
        self.refuses = False
        self.closes_at_bye = True
        self.connections: list[Connection] = []
        self.tried_s: list[float] = []
        """The loop's time at each attempt to connect."""

    @property
    def connection(self) -> Connection:
        """The newest connection."""
        return self.connections[-1]

    async def connect(self, _source: SourceSettings, session: Any) -> asyncio.Transport:
        self.tried_s.append(asyncio.get_running_loop().time())
        if self.refuses:
            raise ConnectError("connection refused by the test")
        connection = Connection(self, session)
        self.connections.append(connection)
        session.connection_made(connection)
        return connection
