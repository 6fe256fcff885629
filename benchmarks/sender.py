"""A server that sends one and the same frame, with new numbers and time stamps, paced or as fast as it goes.

Time stamps are CLOCK_MONOTONIC in µs at the moment of sending, so that whoever receives one knows its age.
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
    """Send so many frames to a client as fast as it takes them, and wait until it has taken the last."""

    client: str
    frames: int


class Paced(NamedTuple):
    """Send so many frames to a client at a rate, by an absolute schedule."""

    client: str
    frames: int
    rate_hz: float


class Sent(NamedTuple):
    """What was sent: frame numbers from ``first``, and how long it took until the client closed, s."""

    first: int
    frames: int
    took_s: float


def send(workload: Workload, clients: list[str]) -> Generator[dict[str, int] | Sent, Blast | Paced, None]:
    """Work of a Worker: listen for each client on a port of its own, tell the ports, then do as asked.

    A client is sent its frames on one connection, which ends then; the next request waits for the next.
    """
    doors = {name: _Door(encode_parameters(workload.scene().parameters)) for name in clients}
    one, block = Frames(workload.packet(), 1), Frames(workload.packet(), _BLOCK_FRAMES)
    numbers = dict.fromkeys(clients, 1)
    request = yield {name: door.port for name, door in doors.items()}
    while True:
        first = numbers[request.client]
        numbers[request.client] += request.frames
        connection = doors[request.client].connections.get(timeout=_WAIT_S)
        began_s = time.monotonic()
        if isinstance(request, Blast):
            _blast(connection, block, first, request.frames)
        else:
            _pace(connection, one, first, request.frames, 1 / request.rate_hz)
        connection.shutdown(socket.SHUT_WR)
        while connection.recv(4096):  # until the client has read all, and closes for its part
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


class _Door:
    """Listens, shakes hands, and keeps connections that ask for frames in ``connections``."""

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
            if self._shake_hands(connection):
                self.connections.put(connection)

    def _shake_hands(self, connection: socket.socket) -> bool:
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
