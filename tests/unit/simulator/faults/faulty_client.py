"""A client of a simulator with faults, without a socket, in virtual time, and packets that faults change."""

import asyncio
import struct
from typing import Any

import numpy as np

from gateway.rtc3d.packets import Packet, PacketReader
from gateway.simulator.faults.base import ActiveFault, Fault, LastingConnectionFault
from gateway.simulator.faults.outgoing import PendingWrite
from gateway.simulator.faults.pipeline import FaultPipeline
from gateway.simulator.simulator import Simulator
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.scripted_client import ScriptedClient
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    MARKERS,
    ByteOrder,
    WireComponent,
    command,
    components_in,
    packet,
    packets_in,
)

RATE_HZ = 1000.0
NEVER_MS = 600_000.0
VERSION = (COMMAND, b"OK-Version 1.0")


class FaultyClient:
    """A client's connection (FilteredConnection) behind the simulator's faults; records what is written."""

    name = "client"

    def __init__(self, number: int = 1, simulator: Simulator | None = None) -> None:
        self.number = number
        self.simulator = simulator or Simulator(CountingScene(RATE_HZ))
        self.faults = self.simulator.faults
        self.server = ScriptedClient(RATE_HZ)
        self.filter: FaultPipeline = self.faults.new_pipeline(self)
        self.simulator.connections.add(self)  # type: ignore[arg-type] # has what faults use
        self.transport: Any = self
        self.calls: list[str] = []
        self.writes: list[tuple[float, bytes]] = []
        self._began_s = asyncio.get_running_loop().time()
        self._reader = PacketReader()

    @property
    def now_s(self) -> float:
        return round(asyncio.get_running_loop().time() - self._began_s, 6)

    def begin(self, *faults: Fault) -> list[ActiveFault]:
        return [self.faults.begin(fault) for fault in faults]

    def send(self, *texts: str) -> None:
        """Send commands, which arrive in one read."""
        self.filter.receive(b"".join(map(command, texts)))

    def ask(self, *texts: str) -> list[tuple[int, bytes]]:
        """Send commands; return the packets that are written meanwhile."""
        self.writes.clear()
        self.send(*texts)
        return self.packets

    def stream_until(self, elapsed_us: int) -> None:
        """Let the server send the frames that are due."""
        self.server.elapsed_us = elapsed_us
        for frame in self.server.session.due_frames(elapsed_us):
            self.filter.send(frame.packet)

    @property
    def packets(self) -> list[tuple[int, bytes]]:
        """The packets that were written."""
        return packets_in(b"".join(data for _, data in self.writes))

    # FilteredConnection and its transport -----------------------------------------------------

    def write(self, data: bytes) -> None:
        self.writes.append((self.now_s, data))

    def handle(self, data: bytes) -> None:
        for received in self._reader.feed(data):
            for reply in self.filter.answer(received):
                self.filter.send(reply)

    def answer(self, packet: Packet) -> list[bytes]:
        return self.server.session.answer(packet)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *_: self.calls.append(name)


# Packets ----------------------------------------------------------------------------------------


def active(fault: Fault, seed: int = 1) -> ActiveFault:
    return ActiveFault(fault, Simulator(CountingScene()).faults, np.random.default_rng(seed))


def markers(
    byte_order: ByteOrder = "big", count: int = 2, number: int = 7, timestamp_us: int = 9000
) -> bytes:
    """Return a 3D component; marker k is at (k, 1.5, -2) with the residual 0.25."""
    sign = ">" if byte_order == "big" else "<"
    items = b"".join(struct.pack(sign + "4f", k, 1.5, -2.0, 0.25) for k in range(count))
    return struct.pack(sign + "IIiqI", 24 + len(items), MARKERS, number, timestamp_us, count) + items


def frame(*components: bytes, byte_order: ByteOrder = "big") -> bytes:
    sign = ">" if byte_order == "big" else "<"
    return packet(DATA, struct.pack(sign + "I", len(components)) + b"".join(components))


def writes_for(
    fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None
) -> list[PendingWrite]:
    """Return what is written instead of one packet that is due at 100 s."""
    return fault.change_writes([PendingWrite(100.0, packet)], active_fault or active(fault))


def changed(fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None) -> bytes:
    [write] = writes_for(fault, packet, active_fault)
    assert (write.due_s, write.joins_previous) == (100.0, False)
    return write.data


def components_in_packet(
    data: bytes, byte_order: ByteOrder = "big", event_bytes: int = 24
) -> list[WireComponent]:
    [(packet_type, body)] = packets_in(data)
    assert packet_type == DATA
    return components_in(body, byte_order, event_bytes=event_bytes)
