"""The frames of a take: read from its files in moments, and sent for each choice of components."""

import itertools
import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from statistics import median_low
from typing import Final

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, prefix_of
from gateway.messages.encode import CONTENT_OFFSET
from gateway.messages.texts import xml_bytes
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.frames import encode_frame
from gateway.rtc3d.packets import PacketType, encode_packet
from gateway.session.server.measurement import exact_rate
from gateway.session.server.scene import NOT_YET_US, DataPacket
from gateway.simulator.take_moments import (
    Moment,
    MomentBuilder,
    RecordedParameters,
    component_bytes,
    is_whole,
)
from gateway.takes.files.reader import TakeMessage, TakeReader

_MAX_LATE_CAPTURE_US: Final = 3_600_000_000
"""A time of capture this far from the arrival is not plausible."""

_RANGE_SLACK_US: Final = 5_000_000
"""Messages of one moment are at most this far apart in a take, so a range is complete after this time."""

_MAX_VERSIONS: Final = 1000
"""How many versions of the parameters are remembered: a faulty server can change them all the time."""


class TakePass:
    """One reading of a take. ``first_utime`` and ``end_utime`` limit its events; None is no limit."""

    def __init__(
        self,
        reader: TakeReader,
        source: str,
        first_utime: int | None,
        end_utime: int | None,
        default: RecordedParameters,
    ) -> None:
        self._reader = reader
        self._source = source
        self._first_utime = -math.inf if first_utime is None else first_utime
        self._end_utime = math.inf if end_utime is None else end_utime
        self._builder = MomentBuilder()
        self._newest: RecordedParameters | None = None
        self._versions: dict[int, RecordedParameters] = {}
        self.default = default
        """The parameters of components before the first parameters in the take."""
        self.first_parameters: RecordedParameters | None = None
        """The first parameters in the take; None if none have been read."""
        self.num_malformed = 0
        """How many messages could not be read."""

    def moments(self) -> Iterator[Moment]:
        """Yield the moments, in order; their times are in µs from the first one. Raises TakeError."""
        for message in self._reader.messages():
            if message.source != self._source:
                continue
            if message.utime >= self._end_utime + _RANGE_SLACK_US:
                break
            if message.key == "parameters":
                self._take_parameters(message.message)
            elif message.key in COMPONENTS_BY_KEY and self._first_utime <= message.utime < self._end_utime:
                yield from self._take_component(message)
        yield from self._builder.finish()

    def _take_parameters(self, message: bytes) -> None:
        try:
            content = decode(message)
        except ProtocolError:
            self.num_malformed += 1
            return
        xml = xml_bytes(content.xml)
        if not xml:  # the server gives no parameters any more
            self._newest = None
            self._versions.pop(content.parameters_version, None)
            return
        if self._newest is None or self._newest.xml != xml:
            self._newest = RecordedParameters(xml)
            _ = self._newest.rates_hz  # parsing takes long, so it is done in this thread
        self.first_parameters = self.first_parameters or self._newest
        self._versions[content.parameters_version] = self._newest
        if len(self._versions) > _MAX_VERSIONS:
            self._versions = dict(itertools.islice(self._versions.items(), _MAX_VERSIONS // 2, None))

    def _take_component(self, message: TakeMessage) -> list[Moment]:
        component = COMPONENTS_BY_KEY[message.key]
        content = message.message[CONTENT_OFFSET:]
        if not is_whole(component, content):
            self.num_malformed += 1
            return []
        prefix = prefix_of(message.message)
        is_plausible = abs(prefix.utime - prefix.capture_utime) < _MAX_LATE_CAPTURE_US
        return self._builder.add(
            component,
            prefix.capture_utime if is_plausible else prefix.utime,
            prefix.session,
            message.message[8:24] + message.message[32:CONTENT_OFFSET],
            content,
            self._versions.get(prefix.parameters_version) or self._newest or self.default,
        )


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
        self._seen: set[ComponentType] = set()  # measured components of the choice
        # Moments that may become frames, each with the gap of its slowest component, None if it has none.
        self._waiting: deque[tuple[Moment, float | None]] = deque()
        self._gaps_us: list[float] = []  # of all rates so far
        self._next_us: dict[float, deque[int]] = {}  # when moments with each gap come, among those that wait
        self._last_us: dict[float, int] = {}  # when the last one was, among those before
        self._horizon_us = -1  # up to here, all moments are known
        self._newest: dict[ComponentType, bytes] = {}  # since the last frame
        # The frames from _first on: their times and contents.
        self._first = 0
        self._times_us: list[int] = []
        self._contents: list[dict[ComponentType, bytes]] = []
        # The newest events: their times and contents.
        self._event_times_us: list[int] = []
        self._events: list[bytes] = []
        self._packet = lru_cache(_CACHED_PACKETS)(self._build_packet)

    # FrameSource ----------------------------------------------------------------------------

    @property
    def rate(self) -> Fraction:
        """See FrameSource."""
        times_us = self._times_us[-_RATE_FRAMES:]
        intervals_us = [later - earlier for earlier, later in pairwise(times_us)]
        if len(intervals_us) > 1:
            return exact_rate(1e6 / median_low(intervals_us))
        rates_hz = [self._rates_hz[each] for each in self.measured if each in self._rates_hz]
        return exact_rate(min(rates_hz)) if rates_hz else _DEFAULT_RATE

    def time_us(self, tick: int) -> int:
        """See FrameSource."""
        index = tick - self._first
        if index < 0:
            return _FORGOTTEN_US
        return self._times_us[index] if index < len(self._times_us) else NOT_YET_US

    def tick_after(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return self._first + bisect_right(self._times_us, elapsed_us)

    def oldest_us(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return elapsed_us - LATE_US

    def packet(self, byte_order: ByteOrder, tick: int, events_from_us: int | None = None) -> DataPacket:
        """See FrameSource. Events of several frames become one component."""
        if events_from_us is not None:
            first = bisect_left(self._event_times_us, events_from_us)
            events = tuple(self._events[first : bisect_right(self._event_times_us, self.time_us(tick))])
            if events:
                return self._build_packet(byte_order, tick, events)
        return self._packet(byte_order, tick)

    def _build_packet(self, byte_order: ByteOrder, tick: int, events: tuple[bytes, ...] = ()) -> DataPacket:
        contents = self._contents[tick - self._first]
        parts: dict[ComponentType, Sequence[bytes]] = {each: [content] for each, content in contents.items()}
        if events:
            parts[ComponentType.EVENT] = events
        components = [component_bytes(*part, byte_order, self._event_bytes) for part in parts.items()]
        return DataPacket(encode_packet(PacketType.DATA, encode_frame(components, byte_order)), tuple(parts))

    # For the scene --------------------------------------------------------------------------

    def add(self, moments: Sequence[Moment], *, is_end: bool) -> None:
        """Take the next moments; ``is_end`` if nothing follows in this pass."""
        for moment in moments:
            self._horizon_us = moment.due_us
            self._add(moment)
        while self._waiting:
            moment, gap_us = self._waiting[0]
            is_frame = False if gap_us is None else self._is_frame(moment.due_us, gap_us)
            if is_frame is None and not is_end:
                return
            self._waiting.popleft()
            if gap_us is not None:
                self._last_us[gap_us] = self._next_us[gap_us].popleft()
            self._newest.update(moment.contents)
            if is_frame is not False:
                self._add_frame(moment.due_us)
        if is_end:
            last_frame_us = self._times_us[-1] if self._times_us else -1
            if self._event_times_us and self._event_times_us[-1] > last_frame_us:
                self._add_frame(self._event_times_us[-1])
            self._newest = {}

    def forget(self, before_us: int) -> None:
        """Forget frames before this time, except for the newest of them."""
        count = bisect_right(self._times_us, before_us) - 1
        if count > _FORGET_FRAMES:
            del self._times_us[:count], self._contents[:count]
            self._first += count
        excess = bisect_right(self._event_times_us, before_us) - _MAX_EVENTS
        if excess > 0:
            del self._event_times_us[:excess], self._events[:excess]

    # Which moments become frames ------------------------------------------------------------

    def _add(self, moment: Moment) -> None:
        found = [component for component in self.measured if component in moment.contents]
        if found and not self._seen:  # until now, the rate of the others counted
            self._waiting = deque((each, None) for each, _ in self._waiting)
            self._next_us.clear()
            self._last_us.clear()
        self._seen.update(found)
        event = moment.contents.get(ComponentType.EVENT) if self.has_events else None
        if event is not None:
            self._event_times_us.append(moment.due_us)
            self._events.append(event)
        others = [] if self._seen else [each for each in moment.contents if each is not ComponentType.EVENT]
        gap_us = None if event is None else _EVENTS_ONLY
        if found or others:
            gap_us = self._gap_us(found or others, moment)
        if gap_us is not None:
            self._next_us.setdefault(gap_us, deque()).append(moment.due_us)
        self._waiting.append((moment, gap_us))

    def _gap_us(self, components: Sequence[ComponentType], moment: Moment) -> float:
        """Return the gap of the slowest of these components, or the one of a rate that is the same."""
        gap_us = 0.0
        for component in components:
            rate_hz = moment.parameters.rates_hz.get(component) or self._rates_hz.get(component)
            if rate_hz is not None:
                gap_us = max(gap_us, min(_GAP_PERIODS * 1e6 / rate_hz, float(_MAX_GAP_US)))
        for known_us in self._gaps_us:
            if known_us <= gap_us * _SAME_GAP and gap_us <= known_us * _SAME_GAP:
                return known_us
        if len(self._gaps_us) == _MAX_GAPS:
            return min(self._gaps_us, key=lambda known_us: abs(known_us - gap_us))
        self._gaps_us.append(gap_us)
        return gap_us

    def _is_frame(self, due_us: int, gap_us: float) -> bool | None:
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
            is_known = is_known and (bool(next_us) or self._horizon_us - due_us >= slower_us)
        return True if is_known else None

    def _add_frame(self, due_us: int) -> None:
        newest = self._newest
        self._times_us.append(due_us)
        self._contents.append({each: newest[each] for each in self.measured if each in newest})
        self._newest = {}
