"""Which messages of a take are replayed, when, and from which place in the file."""

from bisect import bisect_right
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

from gateway.errors import SelectionError, TakeError
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import DESCRIPTIONS, FIRST_PLACE, Place, TakeReader
from gateway.tools.replay.timeline import Jump, ReplayTimeline

STEP_US: Final = 2_000_000
"""How far apart places are; a seek reads at most this much of the take before its target."""


class SeekPoint(NamedTuple):
    """A place in a take: the time there, and by source the newest parameters before it."""

    place: Place
    timeline: ReplayTimeline
    parameters: dict[str, bytes]


class SeekIndex:
    """The places that earlier passes through the take have found, every two seconds."""

    def __init__(self) -> None:
        self._points: list[SeekPoint] = []

    @property
    def next_us(self) -> int:
        """The earliest position at which the next place is to be added."""
        return self._points[-1].timeline.position_us + STEP_US if self._points else 0

    def add(self, point: SeekPoint) -> None:
        """Add the place of a message that comes after all others."""
        self._points.append(point)

    def before(self, position_us: int) -> SeekPoint | None:
        """Return the last place before a position; None if there is none."""
        index = bisect_right(self._points, position_us - 1, key=lambda point: point.timeline.position_us)
        return self._points[index - 1] if index else None


_TAIL_BYTES: Final = 4 * 1024 * 1024


def take_length_us(reader: TakeReader, stop_us: int | None = None) -> int | None:
    """Return the time from the first to the last event, in µs; None if the end of the take is damaged.

    If the replay stops earlier, at ``stop_us``, that is the end.
    It is wrong if somebody has set the clock during the recording.
    """
    log, last_utime = reader.logs[-1].path, reader.start_utime
    try:
        for event in EventLogReader(log).events(max(0, log.stat().st_size - _TAIL_BYTES)):
            last_utime = event.utime
    except (OSError, TakeError):
        return stop_us
    length_us = max(0, last_utime - reader.start_utime)
    return length_us if stop_us is None else min(length_us, stop_us)


_PARAMETERS: Final = "parameters"
_MAX_CACHED: Final = 10_000


class Entry(NamedTuple):
    """A message; ``position_us`` counts from the first one of the take, ``key`` is that of TakeMessage."""

    position_us: int
    source: str
    key: str
    message: bytes


@dataclass(frozen=True)
class Selection:
    """What to replay of a take: None stands for all sources or components, ``stop_us`` None for its end.

    Parameters are always replayed, because they say what the components mean.
    """

    sources: frozenset[str] | None = None
    components: frozenset[str] | None = None
    start_us: int = 0
    stop_us: int | None = None

    def has(self, source: str, key: str) -> bool:
        """Return whether messages of this source and key are selected, wherever they are in the take."""
        if key in DESCRIPTIONS or (self.sources is not None and source not in self.sources):
            return False
        return self.components is None or key == _PARAMETERS or key.partition("/")[0] in self.components


class TakePasses:
    """What a replay publishes of a take, each time that it goes through it or begins at another place.

    Gaps that are longer than ``max_gap_s`` are skipped. ``on_jump`` is called where the time jumps. With an
    ``index``, a pass begins to read near its start, and not each pass finds all damage.
    """

    def __init__(
        self,
        reader: TakeReader,
        selection: Selection,
        *,
        max_gap_s: float,
        on_jump: Callable[[Jump], None],
        index: SeekIndex | None,
    ) -> None:
        self._reader = reader
        self._selection = selection
        self._max_gap_s = max_gap_s
        self._on_jump = on_jump
        self._index = index

    def entries(self, start_us: int, *, reports_jumps: bool) -> Generator[Entry]:
        """Yield the selected messages from ``start_us`` on, and report the jumps after it if that is wanted.

        Raises TakeError if the take cannot be read.
        """

        def report(jump: Jump) -> None:
            if reports_jumps and jump.position_us >= start_us:
                self._on_jump(jump)

        timeline = ReplayTimeline(self._max_gap_s, report)
        return play_list(self._reader, self._selection, timeline, start_us, self._index)

    def nothing_selected(self) -> SelectionError:
        """Return the error for a pass without messages."""
        return SelectionError(
            f"{self._reader.path} has no messages to replay with these options; "
            f"check --source ({', '.join(self._reader.source_names)}), --component, --from and --to"
        )


def play_list(
    reader: TakeReader,
    selection: Selection,
    timeline: ReplayTimeline,
    start_us: int,
    index: SeekIndex | None = None,
) -> Generator[Entry]:
    """Yield the selected messages from ``start_us`` on, after the parameters that are valid there.

    With ``index``, it begins to read at a place that an earlier pass has found, and adds what this one finds.
    Raises TakeError if the take cannot be read.
    """
    stop_us = selection.stop_us
    has = lru_cache(_MAX_CACHED)(selection.has)
    point = None if index is None else index.before(start_us)
    parameters: dict[str, bytes] = {}  # by source: the newest
    if point is not None:
        parameters |= point.parameters
        timeline.go_on(point.timeline)
    is_begun = False
    for utime, source, key, message in reader.messages(FIRST_PLACE if point is None else point.place):
        if index is not None and timeline.position_us >= index.next_us:
            index.add(SeekPoint(reader.place, ReplayTimeline().go_on(timeline), dict(parameters)))
        position_us = timeline.place(source, key, utime)
        is_selected = has(source, key)
        if is_selected and key == _PARAMETERS:
            parameters[source] = message
        if position_us < start_us:
            continue
        if stop_us is not None and position_us > stop_us:
            break
        if not is_begun:
            is_begun = True
            valid = [(name, xml) for name, xml in parameters.items() if xml is not message]
            yield from (Entry(start_us, name, _PARAMETERS, xml) for name, xml in valid)
        if is_selected:
            yield Entry(position_us, source, key, message)
