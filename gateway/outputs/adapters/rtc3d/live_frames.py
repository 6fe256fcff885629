"""The frames of a live source that have certain components, joined by time stamp where they come apart."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
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
from gateway.outputs.adapters.rtc3d.stream_join import (
    KEPT_BYTES,
    KEPT_FRAMES,
    KEPT_SAMPLES,
    ChosenStreams,
    StreamJoin,
)
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.packets import PacketType, encode_packet
from gateway.session.server.scene import NOT_YET_US, DataPacket

_FORGOTTEN_US: Final = -1  # the time of a frame that is not kept: long ago

KEPT_EVENTS: Final = 4096
"""How many frames with events are kept for clients that do not read, or ask for few frames."""

_CACHED_PACKETS: Final = 64  # clients with equal streams share them

_time_us: Final = attrgetter("time_us")


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
        self._arrivals = arrivals
        self._next_arrival = arrivals.frames.first
        self._streams = ChosenStreams(frozenset(self.measured), arrivals, announced_hz)
        # Frames that have arrived while it is not known yet what sets the rate; None once it is.
        self._undecided: Kept[ArrivedFrame] | None = Kept(KEPT_SAMPLES, KEPT_BYTES)
        self._join = StreamJoin(self._streams)
        self._frames: Kept[_LiveFrame] = Kept(KEPT_FRAMES, KEPT_BYTES)
        self._events = RecentEvents()
        self._packets: dict[tuple[ByteOrder, int, int, int], DataPacket] = {}  # the newest
        self.update(arrivals.newest_us)

    # FrameSource ----------------------------------------------------------------------------

    @property
    def rate(self) -> Fraction:
        """See FrameSource."""
        return self._streams.frames_per_s

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
        if events_from_us is not None and self._events.has_any_from(events_from_us):
            first_event = self._events.first_from(events_from_us)
            end_event = self._events.first_from(self._frames[tick].time_us + 1)
            lacks_events = self._events.lacks_any_from(events_from_us)
        key = (byte_order, tick, first_event, end_event)
        packet = self._packets.get(key)
        if packet is None:
            if len(self._packets) >= _CACHED_PACKETS:
                del self._packets[next(iter(self._packets))]
            packet = self._packets[key] = self._build_packet(*key)
        return packet._replace(lacks_events=True) if lacks_events else packet

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
            body = encode_joined(arrivals, self._streams.measured, encoded_events, byte_order)
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
            due_us = self._streams.learned_us()
            if due_us is not None and due_us > elapsed_us:
                return due_us if self._undecided else None
            undecided, self._undecided = self._undecided, None
            for arrival in undecided.since(undecided.first):
                self._take(arrival)
        while (frame := self._join.take_frame(elapsed_us)) is not None:
            samples = self._join.take_samples(frame)
            if samples is not None:
                self._add(frame, samples)
        return self._join.due_us

    def forget(self) -> None:
        """Forget all frames so far."""
        self._frames.clear()
        self._packets.clear()
        self._events.clear()
        self._join.clear()
        if self._undecided is not None:
            self._undecided.clear()
        self._next_arrival = self._arrivals.frames.end

    # Which arrivals become frames -----------------------------------------------------------

    def _take(self, arrival: ArrivedFrame) -> None:
        composition = arrival.composition
        has_events = self.has_events and composition.has_events
        if has_events:
            self._events.append(events_of(arrival))
        streams = self._streams.numbers
        slowest = self._streams.slowest(streams, arrival.time_us)
        if slowest is None:
            slowest = self._streams.slowest(self._streams.all_numbers, arrival.time_us)
            if has_events or slowest == arrival.stream:
                self._add(arrival)
        elif not composition.measured & self._streams.measured:
            pass  # its events wait for the next frame
        elif slowest != arrival.stream:
            self._join.add_sample(arrival)
        elif len(streams) == 1:
            self._add(arrival)
        else:
            self._join.add_frame(arrival)

    def _add(self, arrival: ArrivedFrame, others: tuple[ArrivedFrame, ...] = ()) -> None:
        last_us = self._frames.newest.time_us if self._frames else -1
        self._frames.append(_LiveFrame(max(arrival.time_us, last_us + 1), arrival, others))


class RecentEvents:
    """The newest events, and since when there may be others that are not kept any more."""

    def __init__(self) -> None:
        self._kept: Kept[Events] = Kept(KEPT_EVENTS, KEPT_BYTES)
        self._dropped_us = -1  # when the newest events came that are not kept any more

    def __getitem__(self, number: int) -> Events:
        return self._kept[number]

    def append(self, events: Events) -> None:
        """Append the events of a frame; they replace the oldest ones if these are too many."""
        dropped = self._kept.append(events)
        if dropped is not None:
            self._dropped_us = dropped.time_us

    def has_any_from(self, time_us: int) -> bool:
        """Return whether any events that came at this time or later are kept."""
        return bool(self._kept) and self._kept.newest.time_us >= time_us

    def lacks_any_from(self, time_us: int) -> bool:
        """Return whether any events that came at this time or later are not kept any more."""
        return self._dropped_us >= time_us

    def first_from(self, time_us: int) -> int:
        """Return the number of the first events that came at this time or later."""
        number = self._kept.end  # most clients need only the newest
        while number > self._kept.first and self._kept[number - 1].time_us >= time_us:
            number -= 1
        return number

    def clear(self) -> None:
        """Forget all events."""
        self._kept.clear()
        self._dropped_us = -1
