"""Statistics of the messages of one source, and of its clock, in one pass with bounded memory."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gateway.messages.descriptions.labels import describe
from gateway.messages.sequence_check import SequenceCheck
from gateway.rtc3d.components import ComponentType, is_visible
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import Array, Rows, find_restarts

_MAX_STEP_US: Final = 1_000_000
"""Frames that are further apart do not count for the rate: a pause lies between them."""

_MAX_LAYOUTS: Final = 1000
"""For how many different labels and numbers of items the visibility is counted."""

_MAX_EVENT_IDS: Final = 1000

MAX_LISTED_GAPS: Final = 100
"""How many gaps are listed; all are counted."""

_CARRIED: Final = ("utime", "sequence", "session", "timestamp_us", "frame_number")


class MessageStatistics:
    """The messages of one key: their number, their time, and the gaps in their sequence numbers."""

    def __init__(self) -> None:
        self.num_messages = 0
        self.malformed = 0
        """How many messages could not be read."""
        self.num_bytes = 0
        self.first_utime = self.last_utime = 0
        """``utime`` of the earliest and the latest message, wherever they are in the file."""
        self.gaps = SequenceCheck(max_listed=MAX_LISTED_GAPS)

    def add_messages(self, utime: Array, sequence: Array) -> None:
        """Take the next messages."""
        if not len(utime):
            return
        first_utime, last_utime = int(utime.min()), int(utime.max())
        self.first_utime = min(self.first_utime, first_utime) if self.num_messages else first_utime
        self.last_utime = max(self.last_utime, last_utime)
        self.num_messages += len(utime)
        self.gaps.add_all(sequence, utime)


class ComponentStatistics(MessageStatistics):
    """The messages of one component, their rate, their items, and which of these are visible."""

    def __init__(self, component: ComponentType) -> None:
        super().__init__()
        self.component = component
        self.min_items: int | None = None
        self.max_items: int | None = None
        self.sessions: set[int] = set()
        self.server_restarts = 0
        """How often the server's time stamps or frame numbers started again."""
        self.event_counts: dict[int, int] = {}
        """How many events there are by id; of events only."""
        self.other_events = 0
        """How many events have ids beyond the first 1000."""
        self._last: dict[str, Array] | None = None  # the last row, to continue there
        self._steps = {"timestamp_us": (0, 0), "utime": (0, 0)}  # number and sum of regular steps
        self._visible: dict[tuple[int, int], tuple[int, Array]] = {}  # by version and number of items
        self._labelled: dict[str, list[int]] = {}  # visible, frames

    def add(self, rows: Rows) -> None:
        """Take the next messages."""
        self.malformed += rows.malformed
        heads = rows.heads
        if not len(heads):
            return
        columns = {name: heads[name].astype(heads.dtype[name].newbyteorder("=")) for name in _CARRIED}
        self.add_messages(columns["utime"], columns["sequence"])
        if self._last is not None:
            columns = {name: np.concatenate([self._last[name], column]) for name, column in columns.items()}
        self._last = {name: column[-1:] for name, column in columns.items()}
        restarts = find_restarts(
            columns["utime"], columns["sequence"], columns["timestamp_us"], columns["frame_number"]
        )
        self.server_restarts += int(restarts.server.sum())
        if len(self.sessions) <= _MAX_LAYOUTS:
            self.sessions.update(np.unique(columns["session"]).tolist())
        is_next = (np.diff(columns["sequence"]) == 1) & (np.diff(columns["session"]) == 0)
        for name, (number, total_us) in self._steps.items():
            steps = np.diff(columns[name])[is_next]
            steps = steps[(steps > 0) & (steps <= _MAX_STEP_US)]
            self._steps[name] = number + len(steps), total_us + int(steps.sum())
        self._add_items(rows)

    @property
    def rate_hz(self) -> float | None:
        """The rate of frames by the server's time stamps, or else by arrival, without gaps and pauses."""
        for number, total_us in self._steps.values():
            if total_us:
                return 1e6 * number / total_us
        return None

    def set_labels(self, version: int, parameters: Parameters | None) -> None:
        """Count what was taken with this version of the parameters under its labels.

        Call it when other parameters get this version, and at the end.
        """
        for key in [key for key in self._visible if key[0] == version]:
            frames, visible = self._visible.pop(key)
            labels = describe(self.component, parameters, key[1]).labels
            for label, count in zip(labels, visible.tolist(), strict=True):
                if label in self._labelled or len(self._labelled) <= 10 * _MAX_LAYOUTS:
                    entry = self._labelled.setdefault(label, [0, 0])
                    entry[0] += count
                    entry[1] += frames

    @property
    def versions(self) -> set[int]:
        """The versions of parameters of what has no labels yet."""
        return {version for version, _ in self._visible}

    @property
    def visibility(self) -> dict[str, float]:
        """In how much of the frames that have it each marker or tool is visible, 0 to 1, by label."""
        return {label: visible / frames for label, (visible, frames) in self._labelled.items()}

    def _add_items(self, rows: Rows) -> None:
        numbers = rows.heads["num_items"]
        lowest, highest = int(numbers.min()), int(numbers.max())
        self.min_items = lowest if self.min_items is None else min(self.min_items, lowest)
        self.max_items = highest if self.max_items is None else max(self.max_items, highest)
        if self.component is ComponentType.EVENT:
            for items in rows.items.values():
                self._count_events(items)
        elif self.component in (ComponentType.MARKERS, ComponentType.TOOLS):
            for num_items, items in rows.items.items():
                versions = rows.heads["parameters_version"][numbers == num_items]
                self._count_visible(num_items, items, versions)

    def _count_visible(self, num_items: int, items: Array, versions: Array) -> None:
        if not num_items:
            return
        visible = is_visible(items)
        for version in np.unique(versions).tolist():
            chosen = visible[versions == version]
            key = (version, num_items)
            frames, counts = self._visible.get(key, (0, np.zeros(num_items, np.int64)))
            if key in self._visible or len(self._visible) < _MAX_LAYOUTS:
                self._visible[key] = frames + len(chosen), counts + chosen.sum(axis=0)

    def _count_events(self, items: Array) -> None:
        numbers, counts = np.unique(items["id"], return_counts=True)
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
            if number in self.event_counts or len(self.event_counts) < _MAX_EVENT_IDS:
                self.event_counts[number] = self.event_counts.get(number, 0) + count
            else:
                self.other_events += count


MAX_LISTED_STEPS: Final = 100
"""How many steps are listed; all are counted."""

_WINDOW_US: Final = 1_000_000
_MIN_STEP_US: Final = 500_000
"""Smaller steps look like frames that arrived late."""

_MAX_DEVIATION_US: Final = 100_000
_CONFIRMING_WINDOWS: Final = 5
"""A step counts if the clock stays there for this many windows: after a stall, a network catches up."""

_MAX_PAUSE_WINDOWS: Final = 60


@dataclass(frozen=True, slots=True)
class ClockStep:
    """The clock was set by ``step_us``; ``utime`` is its time after that."""

    utime: int
    step_us: int


class ClockSteps:
    """Finds steps by comparing the times of arrival with the server's time stamps.

    In each second, the frame that arrived earliest counts, as others may have been delayed.
    """

    def __init__(self) -> None:
        self.num_steps = 0
        self.steps: list[ClockStep] = []
        """The first steps, at most MAX_LISTED_STEPS."""
        self._window: tuple[int, int, int] | None = None  # number, least offset, utime
        self._previous = 0  # the number of the last complete window
        self._offset_us: int | None = None  # in the windows so far
        self._pending: list[tuple[int, int]] = []  # offset and utime of windows after a possible step

    def add(self, utime: Array, timestamp_us: Array) -> None:
        """Take the times of arrival and the server's time stamps of the next frames, in µs."""
        if not len(utime):
            return
        offsets = utime - timestamp_us
        numbers = timestamp_us // _WINDOW_US
        (changes,) = np.nonzero(np.diff(numbers))
        starts = np.concatenate([[0], changes + 1])
        least = np.minimum.reduceat(offsets, starts)
        for number, offset, first in zip(
            numbers[starts].tolist(), least.tolist(), utime[starts].tolist(), strict=True
        ):
            if self._window is not None and self._window[0] == number:
                offset = min(offset, self._window[1])  # noqa: PLW2901 - the window continues
                first = self._window[2]  # noqa: PLW2901
            elif self._window is not None:
                self._end_window(*self._window)
            self._window = number, offset, first

    def _end_window(self, number: int, offset: int, utime: int) -> None:
        is_continued = 0 < number - self._previous <= _MAX_PAUSE_WINDOWS
        self._previous = number
        before = self._offset_us
        if before is None or not is_continued or abs(offset - before) < _MIN_STEP_US:
            self._offset_us = offset
            self._pending.clear()
        else:
            if self._pending and abs(offset - self._pending[-1][0]) > _MAX_DEVIATION_US:
                self._pending.clear()
            self._pending.append((offset, utime))
            if len(self._pending) >= _CONFIRMING_WINDOWS:
                self.num_steps += 1
                self._offset_us, step_utime = self._pending[0]
                if len(self.steps) < MAX_LISTED_STEPS:
                    self.steps.append(ClockStep(step_utime, self._offset_us - before))
                self._pending.clear()
