"""A LiveServer with scripted clients, without sockets and threads, and the bytes of frames of a source."""

import asyncio
import io
import logging
import struct
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

from gateway.outputs.adapters.rtc3d.client_filter import SourceState
from gateway.outputs.adapters.rtc3d.live_server import LiveServer
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.runtime.losses import Losses
from gateway.session.server.client_connection import ClientConnection
from tests.unit.session.server.wire import DATA, EVENT, command, packets_in

_ITEM = {1: "4f", 2: "f", 3: "6f", 4: "8f", EVENT: "iqiii"}
SLOW, FAST = 1, 2  # the numbers of streams
TOOL_OUT_OF_VIEW = bytes.fromhex("00000038 00000004 00000007 0000000000002710 00000001" + "ff" * 32)
_Result = TypeVar("_Result")
_CLIENT, _SERVER = ("192.0.2.7", 4711), ("192.0.2.1", 3120)


def component(
    kind: int, number: int, timestamp_us: int, items: Sequence[Sequence[float]], byte_order: ByteOrder = "big"
) -> bytes:
    """Return a component (§7.1)."""
    sign = ">" if byte_order == "big" else "<"
    data = b"".join(struct.pack(sign + _ITEM[kind], *item) for item in items)
    return struct.pack(sign + "IIiqI", 24 + len(data), kind, number, timestamp_us, len(items)) + data


def body(*components: bytes, byte_order: ByteOrder = "big") -> bytes:
    """Return the body of a data frame."""
    return struct.pack((">" if byte_order == "big" else "<") + "I", len(components)) + b"".join(components)


def markers(number: int, timestamp_us: int, byte_order: ByteOrder = "big") -> bytes:
    return component(1, number, timestamp_us, [(number, 2, 3, 0.5)], byte_order)


def analog(number: int, timestamp_us: int, byte_order: ByteOrder = "big") -> bytes:
    return component(2, number, timestamp_us, [(number,), (-1.5,)], byte_order)


def event(number: int, timestamp_us: int, event_id: int) -> bytes:
    return component(EVENT, number, timestamp_us, [(event_id, timestamp_us, -1, -1, -1)])


def frame_of_markers(number: int, *others: bytes) -> bytes:
    """Return the body of frame ``number`` of 100 Hz."""
    return body(markers(number, 10_000 * number), *others)


def event_of(number: int) -> bytes:
    return event(number, 10_000 * number, number)


async def settle() -> None:
    """Let everything happen that is due now, and a millisecond pass."""
    await asyncio.sleep(0.001)


def parameters(label: str, version: int = 1) -> ServerParameters:
    """Return the parameters of a server with one marker."""
    marker = f"<Markers>1</Markers><Marker><Label>{label}</Label></Marker>"
    xml = f"<Parameters><The_3D><Frequency>100</Frequency>{marker}</The_3D></Parameters>".encode()
    return ServerParameters(xml, 1, version, parsed=parse_parameters(xml).parameters)


class Line(asyncio.Transport):
    """The transport of a client: ``written`` is what was sent, of which ``num_unread`` bytes are not read."""

    def __init__(self, address: tuple[str, int] | None = _CLIENT) -> None:
        super().__init__()
        self.address = address
        self.written = bytearray()
        self.num_unread = 0
        self.high_water = 0
        self.is_closed = self.is_aborted = False
        self.options: dict[int, int] = {}
        self.protocol: ClientConnection

    def get_extra_info(self, name: str, default: object = None) -> Any:
        return {"peername": self.address, "sockname": _SERVER, "socket": self}.get(name, default)

    def setsockopt(self, _level: int, option: int, value: int) -> None:
        self.options[option] = value

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:  # noqa: ARG002
        self.high_water = high or 0

    def get_write_buffer_size(self) -> int:
        return self.num_unread

    def write(self, data: Any) -> None:
        self.written += data

    def is_closing(self) -> bool:
        return self.is_closed

    def pause_reading(self) -> None:
        """Do nothing: the test says when bytes arrive."""

    def resume_reading(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        if not self.is_closed:
            self.is_closed = True
            asyncio.get_running_loop().call_soon(self.protocol.connection_lost, None)

    def abort(self) -> None:
        self.is_aborted = True
        self.close()


class Client:
    """A client that has connected."""

    def __init__(self, server: "ScriptedServer") -> None:
        self.line = Line()
        self.connection = self.line.protocol = ClientConnection(server)
        self.connection.connection_made(self.line)

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the packets that have come since the last call."""
        received = packets_in(bytes(self.line.written))
        self.line.written.clear()
        return received

    async def ask(self, *texts: str) -> list[tuple[int, bytes]]:
        """Send commands; return all packets that have come a moment later."""
        return await self.send(b"".join(map(command, texts)))

    async def send(self, sent: bytes) -> list[tuple[int, bytes]]:
        self.connection.filter.receive(sent)
        await settle()
        return self.receive()


class Disk:
    """Reads files at once; ``opened`` are the files that are not closed yet."""

    def __init__(self) -> None:
        self.opened: list[io.IOBase] = []

    async def run(self, call: Callable[[], _Result]) -> _Result:
        await asyncio.sleep(0)
        result = call()
        if isinstance(result, io.IOBase):
            self.opened.append(result)
        return result

    def submit(self, call: Callable[[], object]) -> None:
        call()
        self.opened = [file for file in self.opened if not file.closed]


class ScriptedServer(LiveServer):
    """The server of the source "lab"; ``asked`` are the controls of recordings, answered by ``control``."""

    def __init__(self, max_clients: int = 8) -> None:
        self.state = SourceState("lab")
        self.losses = self.state.losses = Losses(logging.getLogger(__name__), "lab to rtc3d")
        self.changes: list[bool] = []
        self.asked: list[tuple[str, bool, str]] = []
        self.answers: asyncio.Queue[Exception | str] = asyncio.Queue()
        super().__init__(self.state, "127.0.0.1", 0, max_clients, self._wanted_changed, self._control)
        self.files = self.disk = Disk()  # type: ignore[assignment]
        self._live_scene._arrivals.began_us = -1_000_000_000  # frames do not wait until rates are known

    @property
    def is_listening(self) -> bool:
        return True

    def _wanted_changed(self) -> None:
        self.changes.append(self.state.wanted)

    def _control(self, source: str, start: bool, options: str) -> Coroutine[Any, Any, str]:
        self.asked.append((source, start, options))
        return self._answer()

    async def _answer(self) -> str:
        answer = await self.answers.get()
        if isinstance(answer, Exception):
            raise answer
        return answer

    def client(self) -> Client:
        return Client(self)

    async def greeted(self, *texts: str) -> Client:
        """Return a client that has sent a command."""
        client = Client(self)
        await client.ask("Version 1.0", *texts)
        return client

    def arrive(self, number: int) -> None:
        """Let a frame with markers arrive from the source."""
        frame = split_frame(frame_of_markers(number), "big")
        self.take(frame, 1, frozenset(WIRE_ORDER))

    @property
    def is_measuring(self) -> bool:
        return self.elapsed_us() is not None


def frame_numbers(packets: list[tuple[int, bytes]]) -> list[int]:
    """Return the numbers of the data frames among the packets."""
    return [struct.unpack_from(">i", data, 12)[0] for kind, data in packets if kind == DATA]


def write_file(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path
