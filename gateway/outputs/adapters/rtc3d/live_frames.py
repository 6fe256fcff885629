"""The frames of a live source that have certain components, joined by time stamp where they come apart."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from operator import attrgetter
from typing import Final, NamedTuple

from gateway.outputs.adapters.rtc3d.arrivals import (
    ArrivedFrame,
    Events,
    Kept,
    NewestFrames,
    encode_events,
    encode_joined,
    events_of,
    unchanged_body,
)
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.packets import PacketType, encode_packet
from gateway.session.server.measurement import exact_rate
from gateway.session.server.scene import NOT_YET_US, DataPacket

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
_FORGOTTEN_US: Final = -1  # the time of a frame that is not kept: long ago

_KEPT_FRAMES: Final = 1024
_KEPT_SAMPLES: Final = 2048
KEPT_EVENTS: Final = 4096
"""How many frames with events are kept for clients that do not read, or ask for few frames."""

_KEPT_BYTES: Final = 8 * 1024 * 1024
_CACHED_PACKETS: Final = 64  # clients with equal streams share them

_time_us: Final = attrgetter("time_us")
_num_bytes: Final = attrgetter("num_bytes")


class _LiveFrame(NamedTuple):
    """A frame for clients: one that arrived, and the samples of faster streams at its time stamp."""

    time_us: int
    main: ArrivedFrame
    others: tuple[ArrivedFrame, ...]

    @property
    def num_bytes(self) -> int:
        return self.main.num_bytes + sum(arrival.num_bytes for arrival in self.others)


class LiveFrames:
    """The frames of a live source with a choice of components (see FrameSource).

    The slowest stream that has components of the choice sets the rate (§5.3.5): there is a frame for each of
    its frames, with the newest sample of each faster component up to its time stamp, if it is newer than the
    one in the frame before. A frame waits for these samples, but not longer than WAIT_US. If all components
    come on one stream, its frames are passed on as they are. While the slowest stream has no frames, the next
    slower one sets the rate. Events are kept until the next frame; if there is nothing else, they are frames
    of their own. If none of the components comes but events, the slowest of all streams sets the rate, so
    that neither events nor requests wait; frames without events are empty.

    ``requested`` are the components of a command; an empty sequence means all. ``announced_hz`` are the
    rates in the parameters.
    """

    def __init__(
        self,
        requested: Sequence[ComponentType],
        arrivals: NewestFrames,
        announced_hz: Mapping[ComponentType, float],
    ) -> None:
        self.chosen = frozenset(requested or WIRE_ORDER)
        self.has_events = ComponentType.EVENT in self.chosen
        self.measured = tuple(
            each for each in WIRE_ORDER if each in self.chosen and each is not ComponentType.EVENT
        )
        self._takes_all = not requested or self.chosen == frozenset(WIRE_ORDER)
        self._measured = frozenset(self.measured)
        self._arrivals = arrivals
        self._announced_hz = announced_hz
        self._next_arrival = arrivals.frames.first
        self._frames: Kept[_LiveFrame] = Kept(_KEPT_FRAMES, _KEPT_BYTES, _num_bytes)
        self._events: Kept[Events] = Kept(KEPT_EVENTS, _KEPT_BYTES, _num_bytes)
        self._dropped_event_us = -1  # when the newest events came that are not kept any more
        # Frames that have arrived while it is not known yet what sets the rate; None once it is.
        self._undecided: Kept[ArrivedFrame] | None = Kept(_KEPT_SAMPLES, _KEPT_BYTES, _num_bytes)
        self._waiting: deque[ArrivedFrame] = deque()
        self._samples: dict[int, Kept[ArrivedFrame]] = {}  # of faster streams, by the stream's number
        self._joined: set[int] = set()  # the faster streams that have had a sample in a frame
        self._packets: dict[tuple[ByteOrder, int, int, int], DataPacket] = {}  # the newest
        self.update(arrivals.newest_us)

    # FrameSource ----------------------------------------------------------------------------

    @property
    def rate(self) -> Fraction:
        """See FrameSource."""
        periods_us = [self._period_us(stream) for stream in self._streams or self._all_streams]
        longest_us = max((period_us for period_us in periods_us if period_us), default=None)
        if longest_us:
            return exact_rate(1e6 / longest_us)
        announced_hz = [self._announced_hz[each] for each in self.measured if each in self._announced_hz]
        return exact_rate(min(announced_hz)) if announced_hz else _DEFAULT_RATE

    def time_us(self, tick: int) -> int:
        """See FrameSource."""
        if tick >= self._frames.end:
            return NOT_YET_US
        return self._frames[tick].time_us if tick >= self._frames.first else _FORGOTTEN_US

    def tick_after(self, elapsed_us: int) -> int:
        """See FrameSource."""
        frames = self._frames
        if not frames or frames.newest.time_us <= elapsed_us:
            return frames.end
        return frames.first + bisect_right(list(frames.since(frames.first)), elapsed_us, key=_time_us)

    def oldest_us(self, elapsed_us: int) -> int:
        """See FrameSource."""
        return self._frames.oldest.time_us - 1 if self._frames else elapsed_us

    def packet(self, byte_order: ByteOrder, tick: int, events_from_us: int | None = None) -> DataPacket:
        """See FrameSource. Events of several frames become one component."""
        first_event = end_event = 0
        lacks_events = False
        if events_from_us is not None and self._events and self._events.newest.time_us >= events_from_us:
            first_event = self._first_event_from(events_from_us)
            end_event = self._first_event_from(self._frames[tick].time_us + 1)
            lacks_events = self._dropped_event_us >= events_from_us
        key = (byte_order, tick, first_event, end_event)
        packet = self._packets.get(key)
        if packet is None:
            if len(self._packets) >= _CACHED_PACKETS:
                del self._packets[next(iter(self._packets))]
            packet = self._packets[key] = self._build_packet(*key)
        return packet._replace(lacks_events=True) if lacks_events else packet

    def _first_event_from(self, time_us: int) -> int:
        """Return the number of the first events that came at this time or later."""
        events = self._events
        number = events.end  # most clients need only the newest
        while number > events.first and events[number - 1].time_us >= time_us:
            number -= 1
        return number

    def _build_packet(self, byte_order: ByteOrder, tick: int, first_event: int, end_event: int) -> DataPacket:
        frame = self._frames[tick]
        events = [self._events[number] for number in range(first_event, end_event)]
        main, arrivals = frame.main, (frame.main, *frame.others)
        present = frozenset[ComponentType]().union(*(each.composition.measured for each in arrivals))
        components: tuple[ComponentType, ...] = tuple(each for each in self.measured if each in present)
        if events:
            components += (ComponentType.EVENT,)
        own_events = [main.time_us] if main.composition.has_events else []
        body = None
        if not frame.others and own_events == [each.time_us for each in events]:
            body = unchanged_body(main, self.chosen, byte_order, takes_all=self._takes_all)
        if body is None:
            encoded_events = encode_events(events, main, byte_order)
            body = encode_joined(arrivals, self._measured, encoded_events, byte_order)
        return DataPacket(encode_packet(PacketType.DATA, body), components)

    # For the scene --------------------------------------------------------------------------

    @property
    def next_frame(self) -> int:
        """The number of the next frame."""
        return self._frames.end

    def update(self, elapsed_us: int) -> int | None:
        """Take the frames that have arrived; return when a frame that waits is to be sent anyway."""
        arrived = self._arrivals.frames
        if self._next_arrival != arrived.end:
            for arrival in arrived.since(self._next_arrival):
                if self._undecided is None:
                    self._take(arrival)
                else:
                    self._undecided.append(arrival)
            self._next_arrival = arrived.end
        if self._undecided is not None:
            due_us = self._learned_us()
            if due_us is not None and due_us > elapsed_us:
                return due_us if self._undecided else None
            undecided, self._undecided = self._undecided, None
            for arrival in undecided.since(undecided.first):
                self._take(arrival)
        if self._waiting:
            self._release(elapsed_us)
            if self._waiting:
                return self._waiting[0].time_us + WAIT_US
        return None

    def forget(self) -> None:
        """Forget all frames so far."""
        self._frames.clear()
        self._packets.clear()
        self._events.clear()
        self._dropped_event_us = -1
        self._waiting.clear()
        self._samples.clear()
        self._joined.clear()
        if self._undecided is not None:
            self._undecided.clear()
        self._next_arrival = self._arrivals.frames.end

    # Which arrivals become frames -----------------------------------------------------------

    def _learned_us(self) -> int | None:
        """Return until when to wait for the streams of the choice; None if they are known."""
        arrivals = self._arrivals
        missing = self._measured - arrivals.stream_of.keys()
        if not missing and all(self._period_us(stream) is not None for stream in self._streams):
            return None
        is_announced = not missing.isdisjoint(self._announced_hz)
        began_us = max(arrivals.newest_us, 0) if arrivals.began_us is None else arrivals.began_us
        return began_us + (_LEARN_ANNOUNCED_US if is_announced else _LEARN_US)

    def _take(self, arrival: ArrivedFrame) -> None:
        composition = arrival.composition
        has_events = self.has_events and composition.has_events
        if has_events:
            dropped = self._events.append(events_of(arrival))
            if dropped is not None:
                self._dropped_event_us = dropped.time_us
        slowest = self._slowest_stream(self._streams, arrival.time_us)
        if slowest is None:
            slowest = self._slowest_stream(self._all_streams, arrival.time_us)
            if has_events or slowest == arrival.stream:
                self._add(arrival)
        elif not composition.measured & self._measured:
            pass  # its events wait for the next frame
        elif slowest != arrival.stream:
            self._add_sample(arrival)
        elif len(self._streams) == 1:
            self._add(arrival)
        else:
            self._waiting.append(arrival)
            if len(self._waiting) > _KEPT_FRAMES:
                self._add_joined(self._waiting.popleft())

    @property
    def _streams(self) -> set[int]:
        """The streams on which the components of the choice come, or came last."""
        stream_of = self._arrivals.stream_of
        return {stream_of[each] for each in self.measured if each in stream_of}

    @property
    def _all_streams(self) -> set[int]:
        return set(self._arrivals.stream_of.values())

    def _period_us(self, stream: int) -> float | None:
        """Return the time between two frames of a stream, as measured or else as announced."""
        period_us = self._arrivals.rates[stream].period_us
        if period_us is not None:
            return period_us
        stream_of = self._arrivals.stream_of
        announced_hz = [hz for each, hz in self._announced_hz.items() if stream_of.get(each) == stream]
        return 1e6 / min(announced_hz) if announced_hz else None

    def _slowest_stream(self, streams: Iterable[int], now_us: int) -> int | None:
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

    def _add_sample(self, arrival: ArrivedFrame) -> None:
        samples = self._samples.get(arrival.stream)
        if samples is None:
            current = self._streams
            self._samples = {number: each for number, each in self._samples.items() if number in current}
            samples = Kept(_KEPT_SAMPLES, _KEPT_BYTES, _num_bytes)
            self._samples[arrival.stream] = samples
        elif samples and arrival.timestamp_us < samples.newest.timestamp_us:
            samples.clear()  # a new measurement
        samples.append(arrival)

    def _release(self, now_us: int) -> None:
        while self._waiting:
            arrival = self._waiting[0]
            if now_us - arrival.time_us < WAIT_US and not self._has_all_samples(arrival):
                return
            self._add_joined(self._waiting.popleft())

    def _has_all_samples(self, arrival: ArrivedFrame) -> bool:
        """Return whether all other streams have reached the frame's time stamp, or have no frames now."""
        for stream in self._streams:
            rate = self._arrivals.rates[stream]
            behind_us = arrival.timestamp_us - rate.timestamp_us
            if (
                stream != arrival.stream
                and rate.has_times
                and _ROUNDING_US < behind_us < _OTHER_CLOCK_US
                and arrival.time_us - rate.time_us < _FASTER_ALIVE_US
            ):
                return False
        return True

    def _add_joined(self, arrival: ArrivedFrame) -> None:
        """Add a frame with the newest samples of the other streams up to its time stamp.

        At first, a stream may begin with a sample that is later. Then this frame is left out, because it is
        from before the clients asked.
        """
        others = []
        until_us = arrival.timestamp_us + _ROUNDING_US
        for stream in self._streams - {arrival.stream}:
            rate, samples = self._arrivals.rates[stream], self._samples.get(stream, ())
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
                return
        self._add(arrival, tuple(others))

    def _add(self, arrival: ArrivedFrame, others: tuple[ArrivedFrame, ...] = ()) -> None:
        last_us = self._frames.newest.time_us if self._frames else -1
        self._frames.append(_LiveFrame(max(arrival.time_us, last_us + 1), arrival, others))
