"""The workloads: what a server measures, at which rate, and the bytes of its packets."""

import struct
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.messages.encode import CONTENT_OFFSET
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import PACKET_HEADER
from gateway.rtc3d_server.measurement import FrameBuilder
from gateway.simulator.synthetic import SyntheticScene

_EVENT_US: Final = 500_000
"""The time of the first event of the synthetic scene."""

_COMPONENT: Final = struct.Struct(">II")
"""A component's size and type (§7.1), which are not in its message."""


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
