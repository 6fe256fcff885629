"""What ``live`` gives: frames in numpy, decoded from messages that have arrived."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple, cast

import numpy as np

from gateway.client.queued_reception import DescribedSource, QueuedMessage, QueuedReception, QueuedSeries
from gateway.messages.descriptions.labels import Description, describe
from gateway.messages.host_time import STEP_US, clock_difference_us, now_steady_us, now_utime
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import HEAD, Array, Rows, decode_row, decode_rows
from gateway.takes.files.parameters_history import ParametersEntry
from gateway.takes.files.row import Row
from gateway.takes.files.series import Series, SeriesBuilder


class ClockDifference:
    """How far this host's clock is from the gateway's, as far as arriving messages show.

    No message arrives before it is sent: the least difference between both is at most the delay of the
    network. Up to 20 ms, it is taken for that, and both clocks for the same.

    Arrivals are timed by a clock that nobody sets, so it does not matter if this host's clock is set. If
    that of the gateway is set forward, the least difference becomes smaller at once; if it is set back, the
    times of a key go back although its numbers do not, and what was known before no longer holds.
    """

    SAME_US: Final = 20_000
    _WINDOW_US: Final = 30_000_000
    _LATE_US: Final = 1_000_000
    """A message that was overtaken on the network by more is one of a gateway that has started again."""

    def __init__(self) -> None:
        self.offset_us = 0
        """What to add to the gateway's times, in µs, for this host's."""
        self.steady_offset_us = 0
        """The same for this host's steady clock."""
        self._least_us: deque[tuple[int, int]] = deque(maxlen=2)  # begin of a window, least difference in it
        self._newest: dict[str, Sent] = {}

    def add(self, key: str, sent: "Sent") -> None:
        """Take when a message of a key was sent and when it arrived."""
        newest = self._newest.get(key)
        if newest is not None and sent.utime < newest.utime - STEP_US:
            is_before = sent.session == newest.session and sent.sequence < newest.sequence
            if is_before and sent.steady_us - newest.steady_us < self._LATE_US:
                return
            self._least_us.clear()
        self._newest[key] = sent
        difference_us = sent.steady_us - sent.utime
        if not self._least_us or sent.steady_us - self._least_us[-1][0] > self._WINDOW_US:
            self._least_us.append((sent.steady_us, difference_us))
        elif difference_us < self._least_us[-1][1]:
            self._least_us[-1] = (self._least_us[-1][0], difference_us)

    def follow(self, wall_us: int) -> None:
        """Update the offsets: ``wall_us`` is this host's clock minus its steady clock."""
        least_us = min((least for _, least in self._least_us), default=-wall_us) + wall_us
        self.offset_us = 0 if 0 <= least_us <= self.SAME_US else least_us
        self.steady_offset_us = self.offset_us - wall_us


class Sent(NamedTuple):
    """When a message was sent, on the gateway's clock, its numbers, and when it arrived."""

    utime: int
    session: int
    sequence: int
    steady_us: int


class LiveSource(DescribedSource):
    """A source that ``live`` receives."""

    def __init__(self, name: str, channels: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__(name, channels, monotonic)
        self.clock = ClockDifference()
        self._described: dict[tuple[str, int, int], tuple[Parameters, Description]] = {}
        self._described_by: list[ParametersEntry] = []

    def describe(
        self, component: ComponentType, version: int, utime: int, num_items: int
    ) -> tuple[Parameters, Description]:
        """Return the parameters of a frame, by their version and its time, and what they say about it."""
        if self._described_by is not self.entries:
            self._described_by = self.entries
            self._described.clear()
        known = self._described.get((component.key, version, num_items))
        if known is None:
            entry = self.entry_of(version, utime)
            parameters = _NO_PARAMETERS if entry is None else entry.parameters
            known = parameters, describe(component, parameters, num_items)
            if len(self._described) < _MAX_DESCRIPTIONS and self.is_unique(version):
                self._described[component.key, version, num_items] = known
        return known


_MAX_DESCRIPTIONS: Final = 64
_NO_PARAMETERS: Final = Parameters()


class LiveReception(QueuedReception[LiveSource]):
    """What ``live`` receives."""

    takes_poses = False
    _start_utime = 0

    @property
    def start_utime(self) -> int:
        """The time of the first message, in µs since 1970 on its gateway's clock; 0 before."""
        if not self._start_utime:
            times = [source.first_utime for source in self.sources_now]
            self._start_utime = min((each for each in times if each), default=0)
        return self._start_utime

    def _new_source(self, name: str, channels: str) -> LiveSource:
        return LiveSource(name, channels, self.monotonic)


class Frame:
    """One message of a source, or all components of one instant if they are joined.

    ``markers``, ``tools``, ``analog``, ``forces`` and ``events`` are what it has, each a ``Row``: the arrays
    and names of a take's ``Series``, for one frame. Reading one that it does not have raises AttributeError;
    ``rows`` has those that exist, by "3d", "6d", "analog", "force" and "event".

    ``key`` is the component that it belongs to; ``sequence``, ``capture_utime`` and the other numbers are of
    this component. ``gap`` is how many messages are missing before it, on the way or because the program was
    too slow. If components are joined, it is the sum.
    """

    __slots__ = (
        *("_head", "_offset_us", "_others", "_parts", "_source", "_start_utime", "_steady_offset_us"),
        *("gap", "key"),
    )

    def __init__(
        self, source: LiveSource, key: str, parts: Mapping[str, Sequence[Row]], gap: int, start_utime: int
    ) -> None:
        self._source = source
        self._start_utime = start_utime
        self._offset_us = source.clock.offset_us
        self._steady_offset_us = source.clock.steady_offset_us
        self._parts = parts
        self._head = parts[key][-1].head
        self.key = key
        self.gap = gap
        self._others: dict[str, Frame] = {}

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<Frame of {self.source}: {', '.join(self._parts)}, number {self.sequence}>"

    @property
    def source(self) -> str:
        """The name of the source."""
        return self._source.name

    @property
    def sources(self) -> "dict[str, Frame]":
        """The frames of all sources of this instant by name: others than its own only if they are joined."""
        return {self.source: self, **self._others}

    @property
    def row(self) -> Row:
        """The row of ``key``."""
        return self._parts[self.key][-1]

    @property
    def rows(self) -> dict[str, Row]:
        """The components that it has, by their keys; of one that came several times, the newest."""
        return {key: rows[-1] for key, rows in self._parts.items()}

    @property
    def series(self) -> dict[str, Series]:
        """The same as in a take: for each component, an array of everything since the frame before."""
        found = {key: self._series_of(rows) for key, rows in self._parts.items()}
        return {key: series for key, series in found.items() if series is not None}

    @property
    def markers(self) -> Row:
        """The markers; AttributeError if it has none."""
        return self._row("3d", "markers")

    @property
    def tools(self) -> Row:
        """The tools; AttributeError if it has none."""
        return self._row("6d", "tools")

    @property
    def analog(self) -> Row:
        """The analog channels; AttributeError if it has none."""
        return self._row("analog", "analog channels")

    @property
    def forces(self) -> Row:
        """The force plates; AttributeError if it has none."""
        return self._row("force", "forces")

    @property
    def events(self) -> Row:
        """The events; AttributeError if it has none."""
        return self._row("event", "events")

    @property
    def parameters(self) -> Parameters:
        """The server's parameters that describe it; without any section if they are not known."""
        return self.row.parameters

    @property
    def capture_utime(self) -> int:
        """When the server captured it, in µs since 1970 on the gateway's clock, as in a take."""
        return self._head[2]

    @property
    def capture_time(self) -> float:
        """When the server captured it, in s since 1970 on this host's clock: compare it with time.time()."""
        return (self.capture_utime + self._offset_us) / 1e6

    @property
    def age_s(self) -> float:
        """How long ago the server captured it, in s. It grows while the frame is kept."""
        return (now_steady_us() - self.capture_utime - self._steady_offset_us) / 1e6

    @property
    def steady_offset_us(self) -> int:
        """What to add to ``capture_utime``, in µs, for this host's steady clock, which nobody sets.

        With it, times of capture of several gateways can be compared, although their clocks differ. It is as
        known when the frame was read: later frames of the source may have a better one.
        """
        return self._steady_offset_us

    @property
    def seconds(self) -> float:
        """The time of capture in s since the first message, on the gateway's clock."""
        return (self.capture_utime - self._start_utime) / 1e6

    @property
    def utime(self) -> int:
        """When the gateway received it, in µs since 1970 on its clock."""
        return self._head[1]

    @property
    def sequence(self) -> int:
        """The number of the message."""
        return self._head[3]

    @property
    def session(self) -> int:
        """The number of the gateway's connection to the server: it grows with each new one."""
        return self._head[4]

    @property
    def frame_number(self) -> int:
        """The server's number, unchanged."""
        return self._head[6]

    @property
    def timestamp_us(self) -> int:
        """The server's time stamp in µs since its start, unchanged."""
        return self._head[7]

    def joined(self, others: Iterable["Frame"]) -> "Frame":
        """Return this frame with everything that others have, of this source and of others."""
        frames: dict[LiveSource, list[Frame]] = {self._source: [self]}
        for other in others:
            frames.setdefault(other._source, []).append(other)  # noqa: SLF001 - of the same class
        joined = [_merged(each) for each in frames.values()]
        joined[0]._others = {frame.source: frame for frame in joined[1:]}  # noqa: SLF001
        return joined[0]

    def _row(self, key: str, noun: str) -> Row:
        rows = self._parts.get(key)
        if rows is None:
            raise AttributeError(
                f"this frame of {self.source} has no {noun}; it has {', '.join(self._parts)}"
            )
        return rows[-1]

    def _series_of(self, rows: Sequence[Row]) -> Series | None:
        """Return rows as a series; None if they are messages without an event."""
        builder = SeriesBuilder(rows[0].component)
        for row in rows:
            builder.add(Rows(np.array([row.head], HEAD), {len(row.items): row.items[None]}, 0))
        return builder.build(self._source.entries, self._start_utime)


def _merged(frames: Sequence[Frame]) -> Frame:
    """Return frames of one source as one, with the numbers of the first."""
    first = frames[0]
    if len(frames) == 1:
        return first
    parts: dict[str, list[Row]] = {}
    for frame in frames:
        for key, rows in frame._parts.items():  # noqa: SLF001 - of the same class
            parts.setdefault(key, []).extend(rows)
    gap = sum(frame.gap for frame in frames)
    return Frame(first._source, first.key, parts, gap, first._start_utime)  # noqa: SLF001 - see above


def decode_frames(arrivals: Sequence[QueuedMessage], start_utime: int) -> Iterator[Frame]:
    """Yield the frames in messages, in their order. Messages that cannot be read are left out."""
    if not arrivals:
        return
    messages: dict[QueuedSeries, list[bytes]] = {}
    for series, message, *_ in arrivals:
        messages.setdefault(series, []).append(message)
    decoded = {series: _rows(series, each) for series, each in messages.items()}
    wall_us = clock_difference_us(now_utime, now_steady_us)
    for series, _, _, gap, is_past, steady_us in arrivals:
        found = next(decoded[series])
        if found is None:
            series.num_malformed += 1
            series.malformed_gap += 1 + gap
            continue
        head, items = found
        source = cast(LiveSource, series.source)
        if not is_past:
            source.clock.add(series.key, Sent(head[1], head[4], head[3], steady_us))
        source.clock.follow(wall_us)
        component = COMPONENTS_BY_KEY[series.key]
        row = Row(component, head, items, *source.describe(component, head[5], head[1], items.shape[1]))
        total_gap, series.malformed_gap = gap + series.malformed_gap, 0
        yield Frame(source, series.key, {series.key: (row,)}, total_gap, start_utime)


def _rows(series: QueuedSeries, messages: list[bytes]) -> Iterator[tuple[tuple[int, ...], Array] | None]:
    """Yield the fields of HEAD and the items, shape (1, items), of each message; None if it is malformed."""
    component = COMPONENTS_BY_KEY[series.key]
    if len(messages) == 1:  # as usual, if the program keeps up
        yield decode_row(component, messages[0])
        return
    rows = decode_rows(component, messages)
    if rows.malformed:
        yield from (decode_row(component, message) for message in messages)
        return
    num_taken = dict.fromkeys(rows.items, 0)
    for head in rows.heads.tolist():
        first = num_taken[head[-1]]
        num_taken[head[-1]] = first + 1
        yield head, rows.items[head[-1]][first : first + 1]
