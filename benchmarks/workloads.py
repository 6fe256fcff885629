"""What the servers of the benchmarks send: how much, how often, and the bytes of it."""

import struct
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.messages.encode import CONTENT_OFFSET
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import PACKET_HEADER
from gateway.rtc3d_server.frame_builder import FrameBuilder
from gateway.simulator.synthetic import SyntheticScene

_EVENT_US: Final = 500_000
"""When the synthetic scene has its first event."""

_COMPONENT: Final = struct.Struct(">II")
"""A component's size and type (§7.1), which its message leaves out."""


@dataclass(frozen=True)
class Workload:
    """What one server measures, and how often."""

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
        """Return the packet of one frame as the simulator encodes it: all five components, with one event."""
        scene = self.scene()
        tick = round(_EVENT_US * self.rate_hz / 1e6)
        events = scene.events(_EVENT_US, _EVENT_US + 1)
        return FrameBuilder(scene, ()).packet("big", tick, events).packet


LAB: Final = Workload(markers=55, tools=6, analog=69, plates=2, rate_hz=200, analog_rate_hz=2000)
"""A gait laboratory; its analog channels and force plates have a stream of their own."""

DENSE: Final = Workload(markers=100, tools=10, analog=32, plates=2, rate_hz=1000, analog_rate_hz=1000)
"""Five components in every frame. The workload ``blast`` is this, as fast as TCP takes it."""

LAB_STREAMS: Final[list[dict[str, Any]]] = [
    {"components": ["3d", "6d", "event"], "backlog": "all"},
    {"components": ["analog", "force"], "backlog": "all"},
]


class Cut(NamedTuple):
    """Which bytes of a packet a relay publishes, so that it publishes as many as the gateway.

    ``first`` is negative where the gateway's prefix of 36 bytes is longer than what precedes the component.
    """

    component: ComponentType
    first: int
    last: int


def cuts(packet: bytes) -> list[Cut]:
    """Return, for each component of a packet, as many bytes as its message has, its content at their end."""
    found = []
    at = PACKET_HEADER.size + 4  # behind the packet's header and the count of components
    while at < len(packet):
        size, number = _COMPONENT.unpack_from(packet, at)
        first = at + _COMPONENT.size - CONTENT_OFFSET
        found.append(Cut(ComponentType(number), first, at + size))
        at += size
    return found


class Frames:
    """Packets of ``count`` frames in a row, whose numbers and time stamps can be set cheaply."""

    def __init__(self, packet: bytes, count: int) -> None:
        self.data = bytearray(packet * count)
        """The packets, one behind the other."""
        self.packet_bytes = len(packet)
        contents = [cut.first + CONTENT_OFFSET for cut in cuts(packet)]
        self._numbers = [self._fields(">i4", at) for at in contents]
        self._stamps_us = [self._fields(">i8", at + 4) for at in contents]
        self._steps = np.arange(count)

    def _fields(self, dtype: str, offset: int) -> np.ndarray[Any, Any]:
        count = len(self.data) // self.packet_bytes
        return np.ndarray((count,), dtype, self.data, offset, (self.packet_bytes,))

    def stamp(self, number: int, time_us: int) -> None:
        """Number the frames from ``number``, with time stamps from ``time_us`` that are 1 µs apart."""
        numbers, stamps_us = self._steps + number, self._steps + time_us
        for field in self._numbers:
            field[:] = numbers
        for field in self._stamps_us:
            field[:] = stamps_us
