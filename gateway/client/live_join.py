"""Joining the components of one instant, and of several sources, into one frame."""

from collections import deque
from collections.abc import Collection, Sequence
from typing import Final

from gateway.client.live_frames import ClockDifference, Frame
from gateway.rtc3d.components import COMPONENTS_BY_KEY

MAX_WAIT_S: Final = 0.25
"""How long a frame waits for the other components. One that does not come is not awaited until it does."""

MAX_FRAMES: Final = 20_000
"""How many frames of one component may wait: 10 s at 2000 Hz."""

_SET_BACK_US: Final = 100_000
"""A frame that is later by more than one that came after it is of before the gateway's clock was set back."""

_Name = tuple[str, str]  # a source and a component


class Join:
    """Gives each frame of the first component what the others have had since the frame before it.

    Within a source, frames belong together by the server's time stamps; between sources, by their times of
    capture on this host's steady clock. The first component is the first of ``components`` (None: of 3d, 6d,
    analog, force, event) of the first of ``sources`` (none: the first that is heard). If ``components`` are
    given, only they are awaited that are heard, or named with their source.
    """

    def __init__(self, sources: Sequence[str], components: Collection[str] | None) -> None:
        self.num_dropped = 0
        """How many frames were left out, because the first component did not come for too long."""
        self._sources = [*sources]
        self._keys = [*(components or COMPONENTS_BY_KEY)]
        self._is_fixed = components is not None
        self._waiting: dict[_Name, deque[Frame]] = {}
        self._newest: dict[_Name, Frame] = {}
        self._clocks: dict[str, Frame] = {}  # of each source the frame that came last
        self._awaited: set[_Name] = set()
        if components is not None:
            self._awaited = {(source, key) for source in sources for key in components if key != "event"}
        self._instants: deque[tuple[Frame, float]] = (
            deque()
        )  # frames of the first component, and their arrival

    def add(self, frame: Frame, now_s: float) -> None:
        """Take the next frame; ``now_s`` is the time on a clock that nobody sets."""
        name = (frame.source, frame.key)
        if frame.source not in self._sources:
            self._sources.append(frame.source)
        newest = self._newest.get(name)
        if newest is not None and frame.timestamp_us < newest.timestamp_us and not _is_late(frame, newest):
            self._start_again(frame.source)
        if newest is None or not _is_late(frame, newest):
            self._newest[name] = self._clocks[frame.source] = frame
        if frame.key != "event":
            self._awaited.add(name)
        if name == self._first():
            self._instants.append((frame, now_s))
            return
        waiting = self._waiting.setdefault(name, deque())
        waiting.append(frame)
        if len(waiting) > MAX_FRAMES:
            waiting.popleft()
            self.num_dropped += 1

    def take(self, now_s: float) -> list[Frame]:
        """Return the frames that are complete, or have waited long enough, and remove them."""
        taken = []
        while self._instants:
            frame, arrived_s = self._instants[0]
            missing = self._missing(frame)
            if missing and now_s - arrived_s < MAX_WAIT_S:
                break
            self._awaited -= missing
            self._instants.popleft()
            taken.append(frame.joined(self._take_others(frame)))
        return taken

    def wait_s(self, now_s: float) -> float | None:
        """Return after how long ``take`` gives a frame even if nothing arrives; None if never."""
        return max(0.0, self._instants[0][1] + MAX_WAIT_S - now_s) if self._instants else None

    def _first(self) -> _Name | None:
        """Return the component that gives the instants."""
        if self._is_fixed:
            return self._sources[0], self._keys[0]
        names = ((self._sources[0], key) for key in self._keys)
        return next((name for name in names if name in self._newest), None)

    def _missing(self, frame: Frame) -> set[_Name]:
        """Return the components that are still to come for the instant of a frame."""
        return {
            name
            for name in self._awaited
            if name not in self._newest or not self._is_reached(frame, self._newest[name])
        }

    def _take_others(self, frame: Frame) -> list[Frame]:
        others = []
        for waiting in self._waiting.values():
            while waiting and self._is_reached(waiting[0], frame):
                others.append(waiting.popleft())
        return others

    def _is_reached(self, instant: Frame, frame: Frame) -> bool:
        """Return whether a frame belongs to an instant, or to a later one."""
        if frame.source == instant.source:
            return frame.timestamp_us >= instant.timestamp_us
        apart_us = self._offset_us(frame) - self._offset_us(instant)
        if abs(apart_us) <= ClockDifference.SAME_US:
            apart_us = 0  # nothing that delays of the network would not explain: one clock
        return frame.capture_utime + apart_us >= instant.capture_utime

    def _offset_us(self, frame: Frame) -> int:
        """Return what to add to the time of a frame for this host's steady clock, as it is known now.

        That it is the same for all frames of a source keeps their order. Those whose times are later than
        the newest one has are of before the gateway's clock was set back.
        """
        newest = self._clocks[frame.source]
        if frame.capture_utime > newest.capture_utime + _SET_BACK_US:
            return min(frame.steady_offset_us, newest.steady_offset_us)
        return newest.steady_offset_us

    def _start_again(self, source: str) -> None:
        """Forget what waits of a source, because its time stamps start again."""
        for name in [name for name in self._newest if name[0] == source]:
            del self._newest[name]
            self.num_dropped += len(self._waiting.pop(name, ()))
        self.num_dropped += sum(frame.source == source for frame, _ in self._instants)
        self._instants = deque(each for each in self._instants if each[0].source != source)


def _is_late(frame: Frame, newest: Frame) -> bool:
    """Return whether a frame was only overtaken on the network."""
    return frame.session == newest.session and frame.sequence < newest.sequence
