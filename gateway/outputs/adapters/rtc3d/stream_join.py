"""The streams on which the components of a choice come, and the join of their frames by time stamp."""

from collections import deque
from collections.abc import Iterable, Mapping
from fractions import Fraction
from typing import Final

from gateway.outputs.adapters.rtc3d.arrivals import ArrivedFrame, Kept, NewestFrames, StreamRate
from gateway.rtc3d.components import ComponentType
from gateway.session.server.measurement import exact_rate

WAIT_US: Final = 250_000
"""How long a frame waits for the samples of faster components at its time stamp. They come on another
connection, which can stand still for a moment."""

_ALIVE_US: Final = 1_000_000
_ALIVE_PERIODS: Final = 3
"""A stream counts as long as its newest frame is not older than this, whichever is longer."""

_FASTER_ALIVE_US: Final = 250_000
"""Frames do not wait for a faster stream that has had no frames for this long when they arrive."""

_LEARN_US: Final = 100_000
_LEARN_ANNOUNCED_US: Final = 300_000
"""How long frames wait at first, until it is known which components come on which stream, and how often. The
second is for components that the server announces."""

_ROUNDING_US: Final = 2
"""Time stamps of the same moment can differ by this much, because rates are rounded."""

_OTHER_CLOCK_US: Final = 1_000_000
"""A stream whose time stamps are this far behind another one has another time base."""

_SAME_RATE: Final = 1.01  # rates within this factor are one rate
_DEFAULT_RATE: Final = Fraction(100)

KEPT_FRAMES: Final = 1024
KEPT_SAMPLES: Final = 2048
KEPT_BYTES: Final = 8 * 1024 * 1024
"""How much is kept of one series of frames, or of one stream's samples: so many, and so many bytes."""


class ChosenStreams:
    """The streams on which the components of a choice come, and how often frames come on them.

    ``measured`` are these components. ``announced_hz`` are the rates in the parameters.
    """

    def __init__(
        self,
        measured: frozenset[ComponentType],
        arrivals: NewestFrames,
        announced_hz: Mapping[ComponentType, float],
    ) -> None:
        self.measured = measured
        self._arrivals = arrivals
        self._announced_hz = announced_hz

    @property
    def numbers(self) -> set[int]:
        """The streams on which the components of the choice come, or came last."""
        stream_of = self._arrivals.stream_of
        return {stream_of[each] for each in self.measured if each in stream_of}

    @property
    def all_numbers(self) -> set[int]:
        """All streams of the source on which measured components come."""
        return set(self._arrivals.stream_of.values())

    @property
    def frames_per_s(self) -> Fraction:
        """The rate of the slowest stream; before that is known, the one that is announced."""
        periods_us = [self._period_us(stream) for stream in self.numbers or self.all_numbers]
        longest_us = max((period_us for period_us in periods_us if period_us), default=None)
        if longest_us:
            return exact_rate(1e6 / longest_us)
        announced_hz = [self._announced_hz[each] for each in self.measured if each in self._announced_hz]
        return exact_rate(min(announced_hz)) if announced_hz else _DEFAULT_RATE

    def rate(self, stream: int) -> StreamRate:
        """Return how often frames come on a stream, and when the newest one came."""
        return self._arrivals.rates[stream]

    def learned_us(self) -> int | None:
        """Return until when to wait for the streams of the choice; None if they are known."""
        arrivals = self._arrivals
        missing = self.measured - arrivals.stream_of.keys()
        if not missing and all(self._period_us(stream) is not None for stream in self.numbers):
            return None
        is_announced = not missing.isdisjoint(self._announced_hz)
        began_us = max(arrivals.newest_us, 0) if arrivals.began_us is None else arrivals.began_us
        return began_us + (_LEARN_ANNOUNCED_US if is_announced else _LEARN_US)

    def slowest(self, streams: Iterable[int], now_us: int) -> int | None:
        """Return the slowest of these streams; None if none of them has frames now."""
        slowest: int | None = None
        slowest_us = 0.0
        for stream in sorted(streams):
            period_us = self._period_us(stream) or 1.0
            alive_us = max(_ALIVE_US, _ALIVE_PERIODS * period_us)
            is_alive = now_us - self._arrivals.rates[stream].time_us <= alive_us
            if is_alive and period_us > slowest_us * _SAME_RATE:
                slowest, slowest_us = stream, period_us
        return slowest

    def _period_us(self, stream: int) -> float | None:
        """Return the time between two frames of a stream, as measured or else as announced."""
        period_us = self._arrivals.rates[stream].period_us
        if period_us is not None:
            return period_us
        stream_of = self._arrivals.stream_of
        announced_hz = [hz for each, hz in self._announced_hz.items() if stream_of.get(each) == stream]
        return 1e6 / min(announced_hz) if announced_hz else None


class StreamJoin:
    """Frames of the slowest stream that wait for the samples of faster streams at their time stamp."""

    def __init__(self, streams: ChosenStreams) -> None:
        self._streams = streams
        self._waiting: deque[ArrivedFrame] = deque()
        self._samples: dict[int, Kept[ArrivedFrame]] = {}  # of faster streams, by the stream's number
        self._joined: set[int] = set()  # the faster streams that have had a sample in a frame

    @property
    def due_us(self) -> int | None:
        """When the oldest frame is to be sent without further samples; None if no frame waits."""
        return self._waiting[0].time_us + WAIT_US if self._waiting else None

    def add_frame(self, arrival: ArrivedFrame) -> None:
        """Let a frame of the slowest stream wait for its samples."""
        self._waiting.append(arrival)

    def add_sample(self, arrival: ArrivedFrame) -> None:
        """Keep a frame of a faster stream for the frames of the slowest one."""
        samples = self._samples.get(arrival.stream)
        if samples is None:
            current = self._streams.numbers
            self._samples = {number: each for number, each in self._samples.items() if number in current}
            samples = Kept(KEPT_SAMPLES, KEPT_BYTES)
            self._samples[arrival.stream] = samples
        elif samples and arrival.timestamp_us < samples.newest.timestamp_us:
            samples.clear()  # a new measurement
        samples.append(arrival)

    def take_frame(self, now_us: int) -> ArrivedFrame | None:
        """Return the oldest frame if it need not wait any more; None if it must, or if there is none."""
        if not self._waiting:
            return None
        arrival = self._waiting[0]
        must_wait = len(self._waiting) <= KEPT_FRAMES and now_us - arrival.time_us < WAIT_US
        if must_wait and not self._has_all_samples(arrival):
            return None
        return self._waiting.popleft()

    def take_samples(self, arrival: ArrivedFrame) -> tuple[ArrivedFrame, ...] | None:
        """Return the newest samples of the other streams up to the time stamp of a frame.

        At first, a stream may begin with a sample that is later. Then this frame is left out, because it is
        from before the clients asked: the result is None.
        """
        others = []
        until_us = arrival.timestamp_us + _ROUNDING_US
        for stream in self._streams.numbers - {arrival.stream}:
            rate, samples = self._streams.rate(stream), self._samples.get(stream, ())
            newest: ArrivedFrame | None = None
            while samples and (not rate.has_times or samples.oldest.timestamp_us <= until_us):
                newest = samples.pop_oldest()
            if newest is not None:
                others.append(newest)
                self._joined.add(stream)
            elif (
                arrival.time_us - rate.time_us < _FASTER_ALIVE_US
                and stream not in self._joined
                and (not samples or samples.oldest.timestamp_us < arrival.timestamp_us + _OTHER_CLOCK_US)
            ):
                return None
        return tuple(others)

    def clear(self) -> None:
        """Forget all frames and samples."""
        self._waiting.clear()
        self._samples.clear()
        self._joined.clear()

    def _has_all_samples(self, arrival: ArrivedFrame) -> bool:
        """Return whether all other streams have reached the frame's time stamp, or have no frames now."""
        for stream in self._streams.numbers:
            rate = self._streams.rate(stream)
            behind_us = arrival.timestamp_us - rate.timestamp_us
            if (
                stream != arrival.stream
                and rate.has_times
                and _ROUNDING_US < behind_us < _OTHER_CLOCK_US
                and arrival.time_us - rate.time_us < _FASTER_ALIVE_US
            ):
                return False
        return True
