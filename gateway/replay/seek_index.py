"""Places in a take from which reading can go on, so that a seek does not read everything before."""

from bisect import bisect_right
from typing import Final, NamedTuple

from gateway.replay.timeline import TimelineState
from gateway.takes.reader import Place

STEP_US: Final = 2_000_000
"""How far apart places are; a seek reads at most this much of the take before its target."""


class SeekPoint(NamedTuple):
    """A place in a take: the time there, and by source the newest parameters before it."""

    place: Place
    timeline: TimelineState
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
