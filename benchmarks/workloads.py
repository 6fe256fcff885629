"""The workloads, and a server that sends one frame again and again, with new numbers and time stamps.

It sends at a rate or at full speed. The time stamps are CLOCK_MONOTONIC in µs at the moment of sending, so
that a subscriber can compute their age.
"""

import queue
import socket
import struct
import threading
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.messages.encode import CONTENT_OFFSET
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import PACKET_HEADER, PacketType, encode_packet
from gateway.rtc3d.parameters_xml import encode_parameters
from gateway.session.server.measurement import FrameBuilder
from gateway.simulator.synthetic import SyntheticScene

_EVENT_US: Final = 500_000
"""The time of the first event of the synthetic scene."""

_COMPONENT: Final = struct.Struct(">II")
"""A component's size and type (§7.1), which are not in its message."""

_BLOCK_FRAMES: Final = 64
_WAIT_S: Final = 120.0  # catches what hangs; a program on a busy machine may take a minute to start


@dataclass(frozen=True)
class Workload:
    """What one server measures, and its rates."""

    markers: int
    tools: int
    analog: int
    plates: int
    rate_hz: float
    analog_rate_hz: float

    def scene(self) -> SyntheticScene:
        """Return the simulator's scene of this size."""
        return SyntheticScene(
            markers=self.markers,
            tools=self.tools,
            analog=self.analog,
            plates=self.plates,
            rate_hz=self.rate_hz,
            analog_rate_hz=self.analog_rate_hz,
        )

    def packet(self) -> bytes:
        """Return the packet of one frame with all five components and one event, encoded by the simulator."""
        scene = self.scene()
        tick = round(_EVENT_US * self.rate_hz / 1e6)
        return FrameBuilder(scene, ()).packet("big", tick, _EVENT_US).packet


LAB: Final = Workload(markers=55, tools=6, analog=69, plates=2, rate_hz=200, analog_rate_hz=2000)
"""A gait laboratory. Analog channels and force plates are in a stream of their own."""

DENSE: Final = Workload(markers=100, tools=10, analog=32, plates=2, rate_hz=1000, analog_rate_hz=1000)
"""Five components in every frame. The throughput is measured with the same frames at full speed."""

LAB_STREAMS: Final[list[dict[str, Any]]] = [
    {"components": ["3d", "6d", "event"], "backlog": "all"},
    {"components": ["analog", "force"], "backlog": "all"},
]


class Cut(NamedTuple):
    """The bytes of a packet that the relay publishes for one component: as many as the gateway's message has.

    ``first`` is negative if fewer bytes precede the component's content than the gateway's prefix has.
    """

    component: ComponentType
    first: int
    last: int


def cuts(packet: bytes) -> list[Cut]:
    """Return the bytes to publish for each component of a packet; they end with the component's content."""
    result = []
    at = PACKET_HEADER.size + 4  # after the packet header and the component count
    while at < len(packet):
        size, number = _COMPONENT.unpack_from(packet, at)
        first = at + _COMPONENT.size - CONTENT_OFFSET
        result.append(Cut(ComponentType(number), first, at + size))
        at += size
    return result


class Frames:
    """Packets of ``count`` consecutive frames, whose numbers and time stamps can be set quickly."""

    def __init__(self, packet: bytes, count: int) -> None:
        self.data = bytearray(packet * count)
        """All packets, without gaps."""
        self.packet_bytes = len(packet)
        contents = [cut.first + CONTENT_OFFSET for cut in cuts(packet)]
        self._numbers = [self._fields(">i4", at) for at in contents]
        self._stamps_us = [self._fields(">i8", at + 4) for at in contents]
        self._steps = np.arange(count)

    def _fields(self, dtype: str, offset: int) -> np.ndarray[Any, Any]:
        count = len(self.data) // self.packet_bytes
        return np.ndarray((count,), dtype, self.data, offset, (self.packet_bytes,))

    def stamp(self, number: int, time_us: int) -> None:
        """Number the frames from ``number``, and set time stamps from ``time_us`` that are 1 µs apart."""
        numbers, stamps_us = self._steps + number, self._steps + time_us
        for field in self._numbers:
            field[:] = numbers
        for field in self._stamps_us:
            field[:] = stamps_us


class Blast(NamedTuple):
    """A request to send frames to a client as fast as it reads them, until it has read the last one."""

    client: str
    frames: int


class Paced(NamedTuple):
    """A request to send frames to a client at a rate, on an absolute schedule."""

    client: str
    frames: int
    rate_hz: float


class Sent(NamedTuple):
    """What was sent: frame numbers from ``first``, and the time in s until the client closed."""

    first: int
    frames: int
    took_s: float


def send(workload: Workload, clients: list[str]) -> Generator[dict[str, int] | Sent, Blast | Paced, None]:
    """Run the server in a Worker. The first reply has the port of each client; requests are Blast or Paced.

    Each request uses one connection and then closes it; the next request waits until the client reconnects.
    """
    listeners = {name: _Listener(encode_parameters(workload.scene().parameters)) for name in clients}
    one, block = Frames(workload.packet(), 1), Frames(workload.packet(), _BLOCK_FRAMES)
    numbers = dict.fromkeys(clients, 1)
    request = yield {name: listener.port for name, listener in listeners.items()}
    while True:
        first = numbers[request.client]
        numbers[request.client] += request.frames
        connection = listeners[request.client].connections.get(timeout=_WAIT_S)
        began_s = time.monotonic()
        if isinstance(request, Blast):
            _blast(connection, block, first, request.frames)
        else:
            _pace(connection, one, first, request.frames, 1 / request.rate_hz)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(4096):  # the client reads everything, then closes its side
            pass
        connection.close()
        request = yield Sent(first, request.frames, time.monotonic() - began_s)


def _blast(connection: socket.socket, block: Frames, first: int, frames: int) -> None:
    time_us = 0
    for number in range(first, first + frames, _BLOCK_FRAMES):
        time_us = max(time.monotonic_ns() // 1000, time_us + _BLOCK_FRAMES)
        block.stamp(number, time_us)
        count = min(_BLOCK_FRAMES, first + frames - number)
        connection.sendall(memoryview(block.data)[: count * block.packet_bytes])


def _pace(connection: socket.socket, one: Frames, first: int, frames: int, period_s: float) -> None:
    due_s = time.monotonic()
    for number in range(first, first + frames):
        due_s += period_s
        time.sleep(max(0.0, due_s - time.monotonic()))
        one.stamp(number, time.monotonic_ns() // 1000)
        connection.sendall(one.data)


class _Listener:
    """Listens for one client; puts each connection into ``connections`` once it has requested frames."""

    def __init__(self, parameters_xml: bytes) -> None:
        self._xml = encode_packet(PacketType.XML, parameters_xml)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.connections: queue.Queue[socket.socket] = queue.Queue()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            connection, _ = self._listener.accept()
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._handshake(connection):
                self.connections.put(connection)

    def _handshake(self, connection: socket.socket) -> bool:
        while True:
            header = connection.recv(PACKET_HEADER.size, socket.MSG_WAITALL)
            if len(header) < PACKET_HEADER.size:
                return False
            size, _ = PACKET_HEADER.unpack(header)
            text = connection.recv(size - PACKET_HEADER.size, socket.MSG_WAITALL)
            if text.startswith(b"SendParameters"):
                connection.sendall(self._xml)
            else:
                connection.sendall(encode_packet(PacketType.COMMAND, b"OK-" + text))
            if text.startswith(b"StreamFrames"):
                return True
