"""The moments of a take: which recorded components belong to the same frame, and when it is due."""

from bisect import insort
from dataclasses import dataclass, field
from typing import Final

from gateway.rtc3d.components import FRAME_NUMBER_AND_TIMESTAMP, ComponentType
from gateway.simulator.recorded.parameters import RecordedParameters
from gateway.simulator.recorded.timeline import TakeTimeline

_REORDER_US: Final = 500_000
"""Components of one frame that were recorded on two connections are at most this far apart in a take."""

_RELEASE_US: Final = 50_000
"""Moments are released together, because each release costs more than a moment."""

_MAX_WAITING: Final = 20_000
"""How many moments wait for further components at most."""

_UNPACK: Final = FRAME_NUMBER_AND_TIMESTAMP["big"].unpack_from


@dataclass(slots=True)
class Moment:
    """The components that a server measured at one time, from one connection or several.

    ``due_us`` is the time in the take. ``contents`` are frame number, time stamp, count and items of each
    component, big-endian, as recorded. ``parameters`` are those that were valid.
    """

    due_us: int
    timestamp_us: int
    parameters: RecordedParameters
    contents: dict[ComponentType, bytes] = field(default_factory=dict)
    is_complete: bool = False
    """Whether no further component can be added."""

    @property
    def num_bytes(self) -> int:
        """The size of the contents."""
        return sum(map(len, self.contents.values()))


@dataclass(slots=True, frozen=True)
class Recorded:
    """One recorded component. ``stamp`` is equal for all components of one frame of one connection."""

    component: ComponentType
    capture_utime: int
    session: int
    stamp: bytes
    content: bytes
    parameters: RecordedParameters


class MomentBuilder:
    """Puts recorded components together into moments, in the order of their times.

    Components with the same time stamp, or the same stamp, are one moment. The messages of one component
    keep their order, and no two moments have the same time.
    """

    def __init__(self) -> None:
        self._timeline = TakeTimeline()
        self._waiting: list[Moment] = []  # in the order of their times
        self._by_timestamp: dict[int, Moment] = {}  # the newest ones of those that wait
        self._newest: Moment | None = None
        self._newest_stamp = b""
        self._newest_us = 0
        self._last_us: dict[ComponentType, int] = {}  # the newest moment of each component
        self._released_us = -1

    def add(self, recorded: Recorded) -> list[Moment]:
        """Add a component; return the moments that are complete now."""
        component = recorded.component
        _, timestamp_us = _UNPACK(recorded.content)
        due_us = self._timeline.time_us(component, recorded.session, timestamp_us, recorded.capture_utime)
        earliest_us = self._last_us.get(component, -1) + 1
        due_us = max(due_us, earliest_us)
        moment = self._by_timestamp.get(timestamp_us)
        if moment is None and recorded.stamp == self._newest_stamp:
            moment = self._newest
        if (
            moment is None
            or component in moment.contents
            or moment.due_us < earliest_us
            or moment.is_complete
            or abs(moment.due_us - due_us) > _REORDER_US
        ):
            moment = Moment(due_us, timestamp_us, recorded.parameters)
            if not self._waiting or self._waiting[-1].due_us <= due_us:
                self._waiting.append(moment)
            else:
                insort(self._waiting, moment, key=_due_us)
            self._newest, self._newest_stamp = moment, recorded.stamp
            self._newest_us = max(self._newest_us, due_us)
        self._by_timestamp[timestamp_us] = moment
        moment.contents[component] = recorded.content
        self._last_us[component] = moment.due_us
        until_us = self._newest_us - _REORDER_US
        if len(self._waiting) > _MAX_WAITING:
            until_us = self._waiting[_MAX_WAITING // 2].due_us
        elif self._waiting[0].due_us > until_us - _RELEASE_US:
            return []
        return self._release(until_us)

    def finish(self) -> list[Moment]:
        """Return the moments that are left."""
        return self._release(self._newest_us)

    def _release(self, until_us: int) -> list[Moment]:
        count = 0
        for moment in self._waiting:
            if moment.due_us > until_us:
                break
            count += 1
        if not count:
            return []
        released, self._waiting = self._waiting[:count], self._waiting[count:]
        for moment in released:
            self._released_us = moment.due_us = max(moment.due_us, self._released_us + 1)
            moment.is_complete = True
        if not self._waiting or len(self._by_timestamp) > 2 * len(self._waiting) + 1000:
            self._by_timestamp = {each.timestamp_us: each for each in self._waiting}
        return released


def _due_us(moment: Moment) -> int:
    return moment.due_us
