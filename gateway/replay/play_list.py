"""Which messages of a take are replayed, and when."""

from collections.abc import Generator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

from gateway.replay.seek_index import SeekIndex, SeekPoint
from gateway.replay.timeline import ReplayTimeline
from gateway.takes.reader import DESCRIPTIONS, FIRST_PLACE, TakeReader

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
            index.add(SeekPoint(reader.place, timeline.state, dict(parameters)))
        position_us = timeline.place(source, utime)
        is_selected = has(source, key)
        if is_selected and key == _PARAMETERS:
            parameters[source] = message
        if position_us < start_us:
            continue
        if stop_us is not None and position_us > stop_us:
            break
        if not is_begun:
            is_begun = True
            yield from _before(start_us, parameters, message)
        if is_selected:
            yield Entry(position_us, source, key, message)


def _before(start_us: int, parameters: dict[str, bytes], first: bytes) -> Generator[Entry]:
    """Yield the parameters that are valid at the start, except the first message itself."""
    for source, newest in parameters.items():
        if newest is not first:
            yield Entry(start_us, source, _PARAMETERS, newest)
