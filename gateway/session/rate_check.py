"""Compares the rate at which frames arrive with the rate that was requested or announced."""

import logging
from collections.abc import Mapping
from enum import Enum, auto
from typing import Final, NamedTuple

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.runtime.quantities import rate_text
from gateway.session.plan import keys_text
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus

_TOLERANCE: Final = 1.1
"""Rates within this factor are equal."""

_WINDOW_S: Final = 3.0
_MIN_FRAMES: Final = 20
"""A measurement takes at least this long, and at least this many frames."""

_MEASUREMENTS: Final = 3
_MEASUREMENTS_WITHOUT_CLOCK: Final = 10
"""How many measurements in a row must agree before a difference, or its end, is reported. Without a clock of
the server, frames that are read together after a stop of this process look like a higher rate."""

AnnouncedRates = Mapping[ComponentType, float]
"""The rates that the server announces, in Hz."""


class Arrivals(NamedTuple):
    """What has arrived in a session so far.

    ``followed`` is the component type whose time stamps are used, because servers may count the time of each
    type separately. ``num_followed`` is the number of frames that begin with this type, ``timestamp_us`` the
    newest time stamp of these frames. ``components`` are those of the newest frame. ``num_restarts`` counts
    how often the time stamps or frame numbers started again.
    """

    num_frames: int
    followed: ComponentType | None
    num_followed: int
    timestamp_us: int
    components: frozenset[ComponentType]
    num_restarts: int


class _Kind(Enum):
    """How a measured rate can differ."""

    NONE = auto()
    SLOW = auto()
    FAST = auto()
    SHARED = auto()  # slower than announced because of another component in the stream


class RateDifference(NamedTuple):
    """A difference between the measured rate and the right one: its kind, and a sentence about it."""

    kind: _Kind
    text: str


_NO_DIFFERENCE: Final = RateDifference(_Kind.NONE, "")


class _Start(NamedTuple):
    """The beginning of a measurement, and the conditions that must not change during it."""

    time_s: float
    arrivals: Arrivals
    conditions: tuple[object, ...]


class RateWatch:
    """Watches one stream over all its sessions, and reports rates that differ in log and status.

    A rate is measured by the server's time stamps, on which delays and a stop of this process have no effect,
    or by the time of this host while the time stamps are not those of a clock. A difference is reported after
    several measurements in a row, of at least 3 s each. Frames of events only are not counted.
    """

    def __init__(self, status: StreamStatus) -> None:
        self._status = status
        self._start: _Start | None = None
        self._newest_kind = _Kind.NONE  # of the newest measurement
        self._in_a_row = 0  # measurements of this kind
        self._session = 0
        self._reported = _NO_DIFFERENCE  # what the status shows

    def check(
        self,
        stream: StreamSettings,
        announced_hz: AnnouncedRates,
        arrivals: Arrivals,
        now_s: float,
        *,
        is_full_rate: bool,
        reports_sharing: bool,
    ) -> None:
        """Continue the measurement. Call it once a second; ``now_s`` is on the monotonic clock.

        Unless ``is_full_rate``, the server was asked for less than configured, and nothing is measured. With
        ``reports_sharing``, a component that is slower than announced because of another one in the same
        stream is a difference, too.
        """
        status, start = self._status, self._start
        if self._session != status.session:
            status.replace_limitation(self._reported.text, "")
            self._session, self._reported = status.session, _NO_DIFFERENCE
        has_clock, followed = status.clock.has_clock, arrivals.followed
        is_streaming = status.state is StreamState.STREAMING and followed not in {None, ComponentType.EVENT}
        # These must not change during a measurement.
        conditions = (
            *(status.session, has_clock, arrivals.num_restarts),
            *(stream.components, dict(announced_hz), followed),
        )
        self._start = _Start(now_s, arrivals, conditions) if is_streaming and is_full_rate else None
        if self._start is None or start is None or start.conditions != conditions:
            self._in_a_row = 0
            return
        num_frames = arrivals.num_frames - start.arrivals.num_frames
        num_followed = arrivals.num_followed - start.arrivals.num_followed
        if now_s - start.time_s < _WINDOW_S or min(num_frames, num_followed) < _MIN_FRAMES:
            self._start = start
            return
        span_s = now_s - start.time_s
        if has_clock:
            span_s = (arrivals.timestamp_us - start.arrivals.timestamp_us) / 1e6
            if span_s <= 0:
                return  # the server's clock was set back
        difference = _compare(stream, announced_hz, arrivals, num_frames / span_s, num_followed / span_s)
        if difference.kind is _Kind.SHARED and not reports_sharing:
            difference = _NO_DIFFERENCE
        self._note(difference)

    def _note(self, difference: RateDifference) -> None:
        self._in_a_row = self._in_a_row + 1 if difference.kind is self._newest_kind else 1
        self._newest_kind = difference.kind
        has_clock = self._status.clock.has_clock
        if self._in_a_row < (_MEASUREMENTS if has_clock else _MEASUREMENTS_WITHOUT_CLOCK):
            return
        if difference.kind is self._reported.kind:
            return
        self._status.replace_limitation(self._reported.text, difference.text)
        if difference.kind is _Kind.NONE:
            text = "frames arrive at the right rate again"
            self._status.events.log(logging.INFO, text, text)
        self._reported = difference


def _compare(
    stream: StreamSettings,
    announced_hz: AnnouncedRates,
    arrivals: Arrivals,
    frames_hz: float,
    followed_hz: float,
) -> RateDifference:
    """Return how the rate differs, or that it does not.

    Frames are too slow only if all of them together are: a server may leave an empty component out. They are
    too fast only if those with the followed component are: a server may send each component in frames of
    its own.
    """
    rates_hz = {each: announced_hz[each] for each in stream.components if each in announced_hz}
    slowest_hz = _limited(stream, min(rates_hz.values(), default=None))
    followed = arrivals.followed
    own_hz = None if followed is None else _limited(stream, rates_hz.get(followed))
    word = "requested" if isinstance(stream.rate, Frequency | FrequencyDivisor) else "announced"
    if slowest_hz and frames_hz * _TOLERANCE < slowest_hz:
        return RateDifference(
            _Kind.SLOW,
            f"frames arrive at {_hz(frames_hz)} Hz instead of the {word} {_hz(slowest_hz)} Hz; check the "
            "server's real-time processing rate and its load",
        )
    if own_hz and followed_hz > own_hz * _TOLERANCE:
        return RateDifference(
            _Kind.FAST,
            f"frames arrive at {_hz(followed_hz)} Hz instead of the {word} {_hz(own_hz)} Hz; check the rates "
            "in the server's settings",
        )
    shared = [
        each
        for each, rate_hz in rates_hz.items()
        if each in arrivals.components and (_limited(stream, rate_hz) or 0) > frames_hz * _TOLERANCE
    ]
    if shared and slowest_hz and frames_hz < slowest_hz * _TOLERANCE:
        fastest_hz = max(rates_hz[each] for each in shared)
        verb = "arrives" if len(shared) == 1 else "arrive"
        return RateDifference(
            _Kind.SHARED,
            f"{keys_text(shared)} {verb} at {_hz(frames_hz)} Hz instead of {_hz(fastest_hz)} Hz: a stream is "
            "as fast as its slowest component; use streams: auto, or list a stream for each rate",
        )
    return _NO_DIFFERENCE


def _limited(stream: StreamSettings, rate_hz: float | None) -> float | None:
    """Return the rate to expect for a component with this announced rate; None if it is unknown."""
    match stream.rate:
        case Frequency(hz):
            return hz if rate_hz is None else min(hz, rate_hz)
        case FrequencyDivisor(divisor):
            return None if rate_hz is None else rate_hz / divisor
    return rate_hz


def _hz(rate_hz: float) -> str:
    """Return a measured rate without digits that would differ the next time."""
    return f"{rate_hz:.0f}" if rate_hz >= 10 else rate_text(rate_hz)
