"""Which frames a client gets, and when: the rules of §5.3.4 and §5.3.5."""

from dataclasses import dataclass
from fractions import Fraction

from gateway.rtc3d.commands import Frequency, FrequencyDivisor, Rate
from gateway.rtc3d_server.scene import FrameSource


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

    Frame j of the stream (from 0) is the frame of tick ``first_tick`` + ⌈j · stride⌉.
    """

    def __init__(self, frames: FrameSource, rate: Rate | None, first_tick: int) -> None:
        self.frames = frames
        self._first_tick = first_tick
        stride = _stride(rate, frames.rate)
        self._numerator, self._denominator = stride.numerator, stride.denominator
        self._num_passed = 0  # frames of this stream that were sent or dropped
        self.tick = first_tick
        """The tick of the next frame."""

    @property
    def due_us(self) -> int:
        """When the next frame is due; NOT_YET_US if this is not known."""
        return self.frames.time_us(self.tick)

    def advance(self, count: int = 1) -> None:
        """Advance by ``count`` frames, which were sent or dropped."""
        self._num_passed += count
        self.tick = self._first_tick - (-self._num_passed * self._numerator // self._denominator)

    def num_due(self, elapsed_us: int) -> int:
        """Return how many frames are due at ``elapsed_us``."""
        ticks = self.frames.tick_after(elapsed_us) - 1 - self._first_tick
        return max(0, ticks * self._denominator // self._numerator + 1 - self._num_passed)


def _stride(rate: Rate | None, base_rate: Fraction) -> Fraction:
    """Return the number of ticks of ``base_rate`` from one frame to the next, at least 1 (§5.3.5)."""
    match rate:
        case FrequencyDivisor(divisor):
            return Fraction(divisor)
        case Frequency(hz):
            return max(Fraction(1), base_rate / Fraction(hz).limit_denominator(1_000_000))
        case _:
            return Fraction(1)
