"""Which frames a client gets, and when: the rules of §5.3.4 and §5.3.5."""

from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.scene import FrameSource

_SAME_RATE: Final = Fraction(101, 100)
"""Measured rates within this factor are one rate."""


@dataclass(frozen=True, slots=True)
class FrameRequest:
    """A SendCurrentFrame that waits for a frame later than ``after_us``."""

    frames: FrameSource
    after_us: int

    @property
    def due_us(self) -> int:
        """When the frame is due, in µs since the measurement's start; NOT_YET_US if this is not known."""
        return self.frames.time_us(self.frames.tick_after(self.after_us))


class FrameSchedule:
    """The frames of a client's StreamFrames during one measurement (§5.3.5).

    Frame j of the stream (from 0) is the frame of tick ⌈first + j · stride⌉. If the rate of the frames
    changes, so that ``Frequency:n`` needs another stride, the stream continues with that one.
    """

    def __init__(self, frames: FrameSource, rate: Rate | None, first_tick: int) -> None:
        self.frames = frames
        self._rate = rate
        self._base_rate = frames.rate
        self._set_stride(Fraction(first_tick))
        self.tick = first_tick
        """The tick of the next frame."""

    def _set_stride(self, first: Fraction) -> None:
        """Count the frames of this stream from the one at ``first`` on."""
        stride = _stride(self._rate, self._base_rate)
        # As integers with one denominator, because this is computed for every frame of every client.
        self._denominator = first.denominator * stride.denominator
        self._first = first.numerator * stride.denominator
        self._stride = stride.numerator * first.denominator
        self._num_passed = 0  # frames that were sent or dropped

    @property
    def due_us(self) -> int:
        """When the next frame is due; NOT_YET_US if this is not known."""
        return self.frames.time_us(self.tick)

    def advance(self, count: int = 1) -> None:
        """Advance by ``count`` frames, which were sent or dropped."""
        if isinstance(self._rate, Frequency) and self._has_other_rate():
            position = Fraction(self._first + self._num_passed * self._stride, self._denominator)
            self._set_stride(position.limit_denominator(1000))
        self._num_passed += count
        self.tick = -(-(self._first + self._num_passed * self._stride) // self._denominator)

    def _has_other_rate(self) -> bool:
        rate = self.frames.rate
        if self._base_rate < rate * _SAME_RATE and rate < self._base_rate * _SAME_RATE:
            return False
        self._base_rate = rate
        return True

    def num_due(self, elapsed_us: int) -> int:
        """Return how many frames are due at ``elapsed_us``."""
        last_tick = self.frames.tick_after(elapsed_us) - 1
        num_begun = (last_tick * self._denominator - self._first) // self._stride + 1
        return max(0, num_begun - self._num_passed)


def _stride(rate: Rate | None, base_rate: Fraction) -> Fraction:
    """Return the number of ticks of ``base_rate`` from one frame to the next, at least 1 (§5.3.5)."""
    match rate:
        case FrequencyDivisor(divisor):
            return Fraction(divisor)
        case Frequency(hz):
            return max(Fraction(1), base_rate / Fraction(hz).limit_denominator(1_000_000))
        case _:
            return Fraction(1)


class SentCounts:
    """Counts data frames and the components in them."""

    def __init__(self) -> None:
        self._frames: Counter[tuple[ComponentType, ...]] = Counter()

    def add(self, components: tuple[ComponentType, ...]) -> None:
        """Count one frame with these components."""
        self._frames[components] += 1

    @property
    def frames(self) -> int:
        """The number of frames."""
        return self._frames.total()

    @property
    def components(self) -> Counter[str]:
        """How often each component was in a frame, by its key."""
        counts: Counter[str] = Counter()
        for components, frames in self._frames.items():
            counts.update({component.key: frames for component in components})
        return counts
