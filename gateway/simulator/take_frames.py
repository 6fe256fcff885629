"""The frames of a take for each choice of components: which of its moments become frames, and their bytes."""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from statistics import median_low
from typing import Final, Generic, TypeVar

from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.frames import encode_frame
from gateway.rtc3d.packets import PacketType, encode_packet
from gateway.session.server.measurement import exact_rate
from gateway.session.server.scene import NOT_YET_US, DataPacket
from gateway.simulator.take_moments import Moment, component_bytes

LATE_US: Final = 3_000_000
"""Frames that are later than this are dropped: longer than for a live scene, because a take is complete."""

_GAP_PERIODS: Final = 2.5
_MAX_GAP_US: Final = 5_000_000
"""If the slowest component pauses for this many of its periods, a faster one sets the rate."""

_SAME_GAP: Final = 1.01  # rates within this factor are one rate: servers round them
_EVENTS_ONLY: Final = -1.0  # the gap of moments that have only events; components without a rate have 0
_CACHED_PACKETS: Final = 64  # clients with equal streams share them
_RATE_FRAMES: Final = 64  # their intervals determine the rate
_DEFAULT_RATE: Final = Fraction(100)
_MAX_EVENTS: Final = 4096  # are kept for clients that are late
_FORGET_FRAMES: Final = 1000  # are forgotten together
_FORGOTTEN_US: Final = -1  # the time of a frame that has been forgotten: long ago
_MAX_GAPS: Final = 64  # a faulty server can announce another rate all the time

_Item = TypeVar("_Item")


class RecordedFrames:
    """The recorded frames of a choice of components (see FrameSource).

    The slowest component of the choice sets the rate (§5.3.5): there is a frame at each moment that has it,
    with the newest content of the others since the frame before. So components of one rate are all in a
    frame. While the slowest one pauses, or as long as it does not exist, the next slower one sets the rate,
    and so on. As long as the take has had none of the chosen components, each frame of the others becomes one
    without content, so that events are sent in time.

    ``requested`` are the components of a command; an empty sequence means all. ``rates_hz`` are the measured
    rates of components, for those whose rate the server does not announce.
    """

    def __init__(
        self, requested: Sequence[ComponentType], event_bytes: int, rates_hz: Mapping[ComponentType, float]
    ) -> None:
        chosen = [component for component in WIRE_ORDER if not requested or component in requested]
        self.has_events = ComponentType.EVENT in chosen
        self.measured = tuple(component for component in chosen if component is not ComponentType.EVENT)
        self._event_bytes = event_bytes
        self._rates_hz = rates_hz
        self._gaps = FrameGaps()
        self._seen: set[ComponentType] = set()  # measured components of the choice
        # Moments that may become frames, each with the gap of its slowest component, None if it has none.
        self._waiting: deque[tuple[Moment, float | None]] = deque()
        self._newest: dict[ComponentType, bytes] = {}  # since the last frame
        self._frames: TimedItems[dict[ComponentType, bytes]] = TimedItems()  # their contents
        self._events: TimedItems[bytes] = TimedItems()  # the contents of the newest ones
        self._packet = lru_cache(_CACHED_PACKETS)(self._build_packet)

    # FrameSource ----------------------------------------------------------------------------

    @property
    def rate(self) -> Fraction:
        """See FrameSource."""
        times_us = self._frames.times_us[-_RATE_FRAMES:]
        intervals_us = [later - earlier for earlier, later in pairwise(times_us)]
        if len(intervals_us) > 1:
            return exact_rate(1e6 / median_low(intervals_us))
        rates_hz = [self._rates_hz[each] for each in self.measured if each in self._rates_hz]
        return exact_rate(min(rates_hz)) if rates_hz else _DEFAULT_RATE

    def time_us(self, tick: int) -> int:
        """See FrameSource."""
        return self._frames.time_us(tick)

    def tick_after(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return self._frames.number_after(elapsed_us)

    def oldest_us(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return elapsed_us - LATE_US

    def packet(self, byte_order: ByteOrder, tick: int, events_from_us: int | None = None) -> DataPacket:
        """See FrameSource. Events of several frames become one component."""
        if events_from_us is not None:
            events = self._events.between(events_from_us, self.time_us(tick))
            if events:
                return self._build_packet(byte_order, tick, events)
        return self._packet(byte_order, tick)

    def _build_packet(self, byte_order: ByteOrder, tick: int, events: tuple[bytes, ...] = ()) -> DataPacket:
        contents = self._frames[tick]
        parts: dict[ComponentType, Sequence[bytes]] = {each: [content] for each, content in contents.items()}
        if events:
            parts[ComponentType.EVENT] = events
        components = [component_bytes(*part, byte_order, self._event_bytes) for part in parts.items()]
        return DataPacket(encode_packet(PacketType.DATA, encode_frame(components, byte_order)), tuple(parts))

    # For the scene --------------------------------------------------------------------------

    def add(self, moments: Sequence[Moment], *, is_end: bool) -> None:
        """Take the next moments; ``is_end`` if nothing follows in this pass."""
        for moment in moments:
            self._gaps.horizon_us = moment.due_us
            self._add(moment)
        while self._waiting:
            moment, gap_us = self._waiting[0]
            is_frame = False if gap_us is None else self._gaps.is_frame(moment.due_us, gap_us)
            if is_frame is None and not is_end:
                return
            self._waiting.popleft()
            if gap_us is not None:
                self._gaps.pass_next(gap_us)
            self._newest.update(moment.contents)
            if is_frame is not False:
                self._add_frame(moment.due_us)
        if is_end:
            if self._events.last_us > self._frames.last_us:
                self._add_frame(self._events.last_us)
            self._newest = {}

    def forget(self, before_us: int) -> None:
        """Forget frames before this time, except for the newest of them."""
        count = self._frames.num_until(before_us) - 1
        if count > _FORGET_FRAMES:
            self._frames.forget(count)
        excess = self._events.num_until(before_us) - _MAX_EVENTS
        if excess > 0:
            self._events.forget(excess)

    # Which moments become frames ------------------------------------------------------------

    def _add(self, moment: Moment) -> None:
        found = [component for component in self.measured if component in moment.contents]
        if found and not self._seen:  # until now, the rate of the others counted
            self._waiting = deque((each, None) for each, _ in self._waiting)
            self._gaps.forget_moments()
        self._seen.update(found)
        event = moment.contents.get(ComponentType.EVENT) if self.has_events else None
        if event is not None:
            self._events.append(moment.due_us, event)
        others = [] if self._seen else [each for each in moment.contents if each is not ComponentType.EVENT]
        gap_us = None if event is None else _EVENTS_ONLY
        if found or others:
            gap_us = self._gap_us(found or others, moment)
        if gap_us is not None:
            self._gaps.add_next(gap_us, moment.due_us)
        self._waiting.append((moment, gap_us))

    def _gap_us(self, components: Sequence[ComponentType], moment: Moment) -> float:
        """Return the gap of the slowest of these components, or the one of a rate that is the same."""
        gap_us = 0.0
        for component in components:
            rate_hz = moment.parameters.rates_hz.get(component) or self._rates_hz.get(component)
            if rate_hz is not None:
                gap_us = max(gap_us, min(_GAP_PERIODS * 1e6 / rate_hz, float(_MAX_GAP_US)))
        return self._gaps.known(gap_us)

    def _add_frame(self, due_us: int) -> None:
        newest = self._newest
        self._frames.append(due_us, {each: newest[each] for each in self.measured if each in newest})
        self._newest = {}


class FrameGaps:
    """Which moments become frames: those that have no moment of a slower component near them.

    A moment is near if it is less than the gap of its slowest component away: the time for which that one can
    pause before a faster one sets the rate.
    """

    def __init__(self) -> None:
        self.horizon_us = -1
        """Up to here, all moments are known."""
        self._gaps_us: list[float] = []  # of all rates so far
        self._next_us: dict[float, deque[int]] = {}  # when moments with each gap come, among those that wait
        self._last_us: dict[float, int] = {}  # when the last one was, among those before

    def known(self, gap_us: float) -> float:
        """Return the gap so far that is the same as this one; it is a new one if there is none."""
        for known_us in self._gaps_us:
            if known_us <= gap_us * _SAME_GAP and gap_us <= known_us * _SAME_GAP:
                return known_us
        if len(self._gaps_us) == _MAX_GAPS:
            return min(self._gaps_us, key=lambda known_us: abs(known_us - gap_us))
        self._gaps_us.append(gap_us)
        return gap_us

    def add_next(self, gap_us: float, due_us: int) -> None:
        """Note a moment with this gap, which waits until it is known whether it becomes a frame."""
        self._next_us.setdefault(gap_us, deque()).append(due_us)

    def pass_next(self, gap_us: float) -> None:
        """Note that the next moment with this gap does not wait any more."""
        self._last_us[gap_us] = self._next_us[gap_us].popleft()

    def forget_moments(self) -> None:
        """Forget the moments so far."""
        self._next_us.clear()
        self._last_us.clear()

    def is_frame(self, due_us: int, gap_us: float) -> bool | None:
        """Return whether no slower component is near; None if what follows must be known first."""
        is_known = True
        for slower_us in self._gaps_us:
            if slower_us <= gap_us:
                continue
            last_us, next_us = self._last_us.get(slower_us), self._next_us.get(slower_us)
            if last_us is not None and due_us - last_us < slower_us:
                return False
            if next_us and next_us[0] - due_us < slower_us:
                return False
            is_known = is_known and (bool(next_us) or self.horizon_us - due_us >= slower_us)
        return True if is_known else None


class TimedItems(Generic[_Item]):
    """Items in the order of their times, with numbers from 0; the oldest ones can be forgotten."""

    def __init__(self) -> None:
        self.times_us: list[int] = []
        """The times of the items that are kept."""
        self._items: list[_Item] = []
        self._first = 0  # the number of the oldest item that is kept

    def __getitem__(self, number: int) -> _Item:
        return self._items[number - self._first]

    @property
    def last_us(self) -> int:
        """The time of the newest item; -1 if none is kept."""
        return self.times_us[-1] if self.times_us else -1

    def append(self, time_us: int, item: _Item) -> None:
        """Append an item that is not earlier than those before it."""
        self.times_us.append(time_us)
        self._items.append(item)

    def time_us(self, number: int) -> int:
        """Return the time of an item; NOT_YET_US if there is none yet, _FORGOTTEN_US if it is not kept."""
        index = number - self._first
        if index < 0:
            return _FORGOTTEN_US
        return self.times_us[index] if index < len(self.times_us) else NOT_YET_US

    def number_after(self, time_us: int) -> int:
        """Return the number of the first item that is later."""
        return self._first + bisect_right(self.times_us, time_us)

    def num_until(self, time_us: int) -> int:
        """Return how many of the items that are kept are not later."""
        return bisect_right(self.times_us, time_us)

    def between(self, first_us: int, last_us: int) -> tuple[_Item, ...]:
        """Return the items from one time to another, both included."""
        return tuple(self._items[bisect_left(self.times_us, first_us) : bisect_right(self.times_us, last_us)])

    def forget(self, count: int) -> None:
        """Forget the oldest ``count`` items."""
        del self.times_us[:count], self._items[:count]
        self._first += count
