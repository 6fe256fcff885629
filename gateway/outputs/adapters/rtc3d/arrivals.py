"""The frames of a live source as they arrive: the rates of its streams, and the bytes for clients."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from operator import attrgetter
from statistics import median_low
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np

from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, Component, ComponentType, Items, encode_component
from gateway.rtc3d.frames import FrameLayout, RawFrame, encode_frame

_KEPT_ARRIVALS: Final = 256
_KEPT_BYTES: Final = 8 * 1024 * 1024
"""How much of the past is kept for clients that ask for the current frame."""

_LONG_AGO_US: Final = 3_600_000_000
_INTERVALS: Final = 32  # their median is the period of a stream

_Item = TypeVar("_Item")


class Composition(NamedTuple):
    """Which wanted components are in the frames of one layout, and whether these are all that it has."""

    measured: frozenset[ComponentType]
    has_events: bool
    is_complete: bool


class ArrivedFrame(NamedTuple):
    """A frame, when it arrived and on which stream.

    ``time_us`` is on the clock of the measurement and grows with every arrival. ``timestamp_us`` is the
    server's. ``stream`` is the number of the connection.
    """

    frame: RawFrame
    composition: Composition
    stream: int
    time_us: int
    timestamp_us: int

    @property
    def num_bytes(self) -> int:
        """The size of the frame."""
        return len(self.frame.body)


class Kept(Generic[_Item]):
    """The newest items of a series: at most so many, and so many bytes, but at least one.

    Items have numbers from 0. ``first`` is the number of the oldest item that is kept.
    """

    def __init__(
        self, most: int, max_bytes: int, num_bytes: Callable[[_Item], int] = attrgetter("num_bytes")
    ) -> None:
        self.first = 0
        self._items: deque[_Item] = deque()
        self._most = most
        self._max_bytes = max_bytes
        self._num_bytes = num_bytes
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._items)

    @property
    def end(self) -> int:
        """The number of the next item."""
        return self.first + len(self._items)

    @property
    def newest(self) -> _Item:
        """The newest item. Raises IndexError if there is none."""
        return self._items[-1]

    @property
    def oldest(self) -> _Item:
        """The oldest item. Raises IndexError if there is none."""
        return self._items[0]

    def __getitem__(self, number: int) -> _Item:
        return self._items[number - self.first]

    def since(self, number: int) -> Iterator[_Item]:
        """Yield the items from this number on that are kept."""
        for index in range(max(0, number - self.first), len(self._items)):
            yield self._items[index]

    def append(self, item: _Item) -> _Item | None:
        """Append an item, and drop the oldest ones that are too many; return the last one dropped."""
        self._items.append(item)
        self._bytes += self._num_bytes(item)
        dropped = None
        while len(self._items) > self._most or (self._bytes > self._max_bytes and len(self._items) > 1):
            dropped = self.pop_oldest()
        return dropped

    def pop_oldest(self) -> _Item:
        """Drop the oldest item and return it. Raises IndexError if there is none."""
        item = self._items.popleft()
        self._bytes -= self._num_bytes(item)
        self.first += 1
        return item

    def clear(self) -> None:
        """Drop all items; their numbers are used up."""
        self.first = self.end
        self._items.clear()
        self._bytes = 0


class StreamRate:
    """How often frames come on one stream: from the server's time stamps, or else from their arrivals."""

    def __init__(self) -> None:
        self.time_us = 0
        """When the newest frame arrived."""
        self.timestamp_us = 0
        """The newest time stamp."""
        self.has_times = True
        """Whether the time stamps increase, as far as is known."""
        self._num_frames = 0
        self._intervals_us: deque[int] = deque(maxlen=_INTERVALS)
        self._period_us = 0

    def add(self, arrival: ArrivedFrame) -> None:
        """Count a frame."""
        step_us = arrival.timestamp_us - self.timestamp_us
        elapsed_us = arrival.time_us - self.time_us
        self.time_us, self.timestamp_us = arrival.time_us, arrival.timestamp_us
        self._num_frames += 1
        if self._num_frames > 1:
            self.has_times = step_us > 0
            self._intervals_us.append(step_us if step_us > 0 else elapsed_us)
            self._period_us = 0

    def restart(self) -> None:
        """Go on with a new measurement, whose clock starts at 0; the rate is probably the same."""
        self.time_us = self._num_frames = 0

    def skip(self, pause_us: int) -> None:
        """Go on after a pause in which no frames were taken: it says nothing about the stream."""
        self.time_us += pause_us
        self._num_frames = 0

    def follow(self, former: "StreamRate") -> None:
        """Begin with the rate of a stream that this one replaces."""
        self._intervals_us.extend(former._intervals_us)  # noqa: SLF001 - the same class

    @property
    def period_us(self) -> int | None:
        """The usual time between two frames; None before the third frame."""
        if len(self._intervals_us) < 2:
            return None
        if not self._period_us:
            self._period_us = max(1, median_low(self._intervals_us))
        return self._period_us


class NewestFrames:
    """The newest frames of a source, and the streams on which its components come.

    With ``streams: auto``, components of different rates come in different frames on different connections.
    """

    def __init__(self) -> None:
        self.frames: Kept[ArrivedFrame] = Kept(_KEPT_ARRIVALS, _KEPT_BYTES)
        """The newest frames."""
        self.stream_of: dict[ComponentType, int] = {}
        """On which stream each measured component came last."""
        self.rates: dict[int, StreamRate] = {}
        """The rate of each stream, by its number."""
        self.newest_us = -1
        """When the newest frame arrived."""
        self.began_us: int | None = None
        """When the first frame of the first measurement arrived; None before it."""
        self._composition = lru_cache(64)(_composition)

    def add(
        self, frame: RawFrame, stream: int, wanted: frozenset[ComponentType], elapsed_us: int
    ) -> ArrivedFrame | None:
        """Add a frame with its ``wanted`` components; return None if it has none of them."""
        composition = self._composition(frame.layout, wanted)
        if not composition.measured and not composition.has_events:
            return None
        former_us, self.newest_us = self.newest_us, max(elapsed_us, self.newest_us + 1)
        if not self.frames:
            for known in self.rates.values():
                known.skip(self.newest_us - max(former_us, 0))
        if self.began_us is None:
            self.began_us = self.newest_us
        arrival = ArrivedFrame(frame, composition, stream, self.newest_us, frame.number_and_timestamp[1])
        if composition.measured:
            rate = self.rates.get(stream)
            if rate is None:
                rate = self.rates[stream] = StreamRate()
            rate.add(arrival)
            for component in composition.measured:
                if self.stream_of.get(component) != stream:
                    self._move(component, stream)
        self.frames.append(arrival)
        return arrival

    def restart(self) -> None:
        """Forget the frames: a new measurement begins. Which component comes on which stream stays known."""
        self.frames.clear()
        self.newest_us = -1
        if self.began_us is not None:
            self.began_us = -_LONG_AGO_US
        for rate in self.rates.values():
            rate.restart()

    def _move(self, component: ComponentType, stream: int) -> None:
        """Note that a component comes on another stream now, and forget streams that have ended."""
        former = self.rates.get(self.stream_of.get(component, stream))
        if former is not None and self.rates[stream].period_us is None:
            self.rates[stream].follow(former)
        self.stream_of[component] = stream
        used = set(self.stream_of.values())
        self.rates = {number: rate for number, rate in self.rates.items() if number in used}


def _composition(layout: FrameLayout, wanted: frozenset[ComponentType]) -> Composition:
    types = [component.type for component in layout.components]
    present = wanted.intersection(types)
    return Composition(
        present - {ComponentType.EVENT}, ComponentType.EVENT in present, wanted.issuperset(types)
    )


_HEADER_BYTES: Final = 8  # size and type, before a component's content


class Events(NamedTuple):
    """The event components of a frame that arrived at ``time_us``."""

    time_us: int
    components: tuple[Component, ...]

    @property
    def num_bytes(self) -> int:
        """The size of the components."""
        return sum(len(component.content) for component in self.components)


def events_of(arrival: ArrivedFrame) -> Events:
    """Return the events of a frame."""
    frame = arrival.frame
    return Events(
        arrival.time_us,
        tuple(
            frame.component(index)
            for index, component in enumerate(frame.layout.components)
            if component.type is ComponentType.EVENT
        ),
    )


def unchanged_body(
    arrival: ArrivedFrame, chosen: frozenset[ComponentType], byte_order: ByteOrder, *, takes_all: bool
) -> bytes | None:
    """Return the body as it arrived; None if it has another byte order, or more than the chosen components.

    Components of unknown type are part of all components, but of no choice of some.
    """
    frame, composition = arrival.frame, arrival.composition
    is_chosen = composition.measured <= chosen and (
        not composition.has_events or ComponentType.EVENT in chosen
    )
    has_others = bool(frame.layout.unknown_types) and not takes_all
    if frame.layout.byte_order != byte_order or not composition.is_complete or not is_chosen or has_others:
        return None
    return frame.body


def encode_joined(
    arrivals: Iterable[ArrivedFrame],
    chosen: frozenset[ComponentType],
    events: Sequence[bytes],
    byte_order: ByteOrder,
) -> bytes:
    """Return a body with the ``chosen`` components of several frames, each as it came, and with ``events``.

    If two frames have the same component, the first frame counts.
    """
    found: dict[ComponentType, list[bytes]] = {}
    for arrival in arrivals:
        frame, missing = arrival.frame, (chosen & arrival.composition.measured) - found.keys()
        for index, component in enumerate(frame.layout.components):
            if component.type not in missing:
                continue
            if frame.layout.byte_order == byte_order:
                start, end = frame.layout.content_spans[index]
                data = frame.body[start - _HEADER_BYTES : end]
            else:
                data = _encoded(frame.component(index), byte_order)
            found.setdefault(component.type, []).append(data)
    parts = [part for component_type in WIRE_ORDER for part in found.get(component_type, ())]
    return encode_frame([*parts, *events], byte_order)


def _encoded(component: Component, byte_order: ByteOrder) -> bytes:
    return encode_component(
        component.type, component.frame_number, component.timestamp_us, component.items(), byte_order
    )


def encode_events(events: Sequence[Events], main: ArrivedFrame, byte_order: ByteOrder) -> list[bytes]:
    """Return the event components of a frame: those of ``main`` as they came, if there are no others.

    Otherwise all events become one component for each size of events, as a server sends them at a low rate:
    with the time stamp of the frame.
    """
    components = [component for each in events for component in each.components]
    if all(each.time_us == main.time_us for each in events):
        return [_encoded(component, byte_order) for component in components]
    by_size: dict[int, list[Items]] = {}
    for component in components:
        items = component.items()
        items = items.astype(items.dtype.newbyteorder(byte_order), copy=False)
        by_size.setdefault(component.item_bytes, []).append(items)
    number_and_timestamp = main.frame.number_and_timestamp
    return [
        encode_component(ComponentType.EVENT, *number_and_timestamp, np.concatenate(same_size), byte_order)
        for same_size in by_size.values()
    ]
