"""Which messages of a take are replayed, and when."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Final, NamedTuple

from gateway.replay.timeline import ReplayTimeline
from gateway.takes.reader import TakeReader

_PARAMETERS: Final = "parameters"
_DESCRIPTION: Final = "take"


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
        if key == _DESCRIPTION or (self.sources is not None and source not in self.sources):
            return False
        return self.components is None or key == _PARAMETERS or key.partition("/")[0] in self.components


def play_list(
    reader: TakeReader, selection: Selection, timeline: ReplayTimeline, start_us: int
) -> Generator[Entry]:
    """Yield the selected messages from ``start_us`` on, after the parameters that are valid there.

    Raises TakeError if the take cannot be read.
    """
    stop_us = selection.stop_us
    selected: dict[str, dict[str, bool]] = {}  # by source and key
    parameters: dict[str, bytes] = {}  # by source: the newest before start_us
    for utime, source, key, message in reader.messages():
        position_us = timeline.place(source, utime)
        keys = selected.setdefault(source, {})
        is_selected = keys.get(key)
        if is_selected is None:
            is_selected = keys[key] = selection.has(source, key)
        if position_us < start_us:
            if is_selected and key == _PARAMETERS:
                parameters[source] = message
            continue
        if stop_us is not None and position_us > stop_us:
            break
        if parameters:
            for name, newest in parameters.items():
                yield Entry(start_us, name, _PARAMETERS, newest)
            parameters = {}
        if is_selected:
            yield Entry(position_us, source, key, message)
