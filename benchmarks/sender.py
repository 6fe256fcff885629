"""A server that sends one frame again and again, with new numbers and time stamps.

It sends at a rate or at full speed. The time stamps are CLOCK_MONOTONIC in µs at the moment of sending, so
that a subscriber can compute their age.
"""

import queue
import socket
import threading
import time
from collections.abc import Generator
from typing import Final, NamedTuple

from benchmarks.workloads import Frames, Workload
from gateway.rtc3d.packets import PACKET_HEADER, PacketType, encode_packet
from gateway.rtc3d.parameters_xml import encode_parameters

_BLOCK_FRAMES: Final = 64
_WAIT_S: Final = 30.0


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
