"""The contract between a scene and the RT server that serves it."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import LONG_EVENT, ByteOrder, ComponentType
from gateway.rtc3d.parameters import General, Parameters

SampleNumbers = npt.NDArray[np.int64]
"""Numbers of samples of one component, shape (count,), counted from 0 at the start of the measurement."""

NO_EVENTS: Final = np.zeros(0, LONG_EVENT)
"""An empty array of events."""

NOT_YET_US: Final = 2**63 - 1
"""The time of a frame whose time is not known yet."""


class DataPacket(NamedTuple):
    """A type-3 packet's bytes, the components in it, and whether it lacks events that are not kept."""

    packet: bytes
    components: tuple[ComponentType, ...]
    lacks_events: bool = False


class FrameSource(Protocol):
    """The frames that have certain components, during one measurement.

    Frames have numbers (ticks) that grow with time; all times are in µs since the measurement's start.
    """

    @property
    def measured(self) -> Sequence[ComponentType]:
        """The requested components except events."""

    @property
    def has_events(self) -> bool:
        """Whether events were requested and can occur."""

    @property
    def rate(self) -> Fraction:
        """Frames per second: the rate of the slowest measured component (§5.3.5)."""

    def time_us(self, tick: int) -> int:
        """Return when a frame is due; NOT_YET_US if this is not known yet."""

    def tick_after(self, elapsed_us: int) -> int:
        """Return the first frame that is due later than ``elapsed_us``."""

    def oldest_us(self, elapsed_us: int) -> int:
        """Return the time of the oldest frame that is still sent; older ones are dropped."""

    def packet(self, byte_order: ByteOrder, tick: int, events_from_us: int | None = None) -> DataPacket:
        """Return a frame; it has the events from ``events_from_us`` to its own time, both included."""


class Scene(Protocol):
    """The content of a measurement. Its methods never block."""

    @property
    def parameters(self) -> Parameters:
        """All sections of §6 that are valid now; the server fills in General if it is None."""

    @property
    def length_us(self) -> int | None:
        """The time of one pass in µs; None if the scene has no end, or if it is not known yet."""

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:
        """Return the XML of some sections (keys of SECTIONS; empty means all), with the server's General."""

    def start(self) -> None:
        """Begin a measurement: its first pass."""

    def advance(self, elapsed_us: int) -> int | None:
        """Prepare the frames around this time; return when to call this again, None for never."""

    def stop(self) -> None:
        """End the measurement."""

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> FrameSource:
        """Return the frames with these components; an empty sequence means all.

        ``event_bytes`` is the size of an event: 24 as NDI's code writes events, or 16 as in §7.7 (field
        note 6).
        """
