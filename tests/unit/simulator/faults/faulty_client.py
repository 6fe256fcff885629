"""A client of a simulator with faults, without a socket."""

import asyncio
from typing import Any, cast

from gateway.rtc3d.packets import Packet, PacketReader
from gateway.session.server.client_connection import ClientConnection
from gateway.simulator.fault_pipeline import FaultPipeline
from gateway.simulator.faults import ActiveFault, Fault
from gateway.simulator.simulator import Simulator
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.scripted_client import ScriptedClient
from tests.unit.session.server.wire import COMMAND, command, packets_in

RATE_HZ = 1000.0
VERSION = (COMMAND, b"OK-Version 1.0")


class FaultyClient:
    """A client's connection (ClientConnection) behind the simulator's faults; records what is written."""

    name = "client"

    def __init__(self, number: int = 1, simulator: Simulator | None = None) -> None:
        self.number = number
        self.simulator = simulator or Simulator(CountingScene(RATE_HZ))
        self.faults = self.simulator.faults
        self.server = ScriptedClient(RATE_HZ)
        self.filter: FaultPipeline = self.faults.new_pipeline(cast(ClientConnection, self))
        self.simulator.connections.add(self)  # type: ignore[arg-type] # has what faults use
        self.transport: Any = self
        self.calls: list[str] = []
        self.writes: list[tuple[float, bytes]] = []
        self._began_s = asyncio.get_running_loop().time()
        self._reader = PacketReader()

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

    # ClientConnection and its transport -----------------------------------------------------

    def write(self, data: bytes) -> None:
        elapsed_s = asyncio.get_running_loop().time() - self._began_s
        self.writes.append((round(elapsed_s, 6), data))

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
