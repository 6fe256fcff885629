"""A take during one measurement: its passes one after the other, read ahead, and placed in time."""

import logging
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from typing import Final, NamedTuple

from gateway.errors import TakeError
from gateway.rtc3d.components import ComponentType
from gateway.runtime.safe_text import safe_text
from gateway.runtime.workers import WorkerThread
from gateway.simulator.take_frames import LATE_US, RecordedFrames
from gateway.simulator.take_moments import Moment, RecordedParameters
from gateway.simulator.take_pass import PlayedSource, TakePass
from gateway.takes.files.reader import TakeReader

_AHEAD_US: Final = 3_000_000
_MAX_AHEAD_BYTES: Final = 64 * 1024 * 1024
"""How much of a take is read ahead, whichever is less: with more objects, garbage collection takes longer."""

_BATCH_BYTES: Final = 1024 * 1024
_BATCH_MOMENTS: Final = 200
"""How much is read at once, whichever is less: this takes some milliseconds, while frames are sent."""

_KEPT_US: Final = 1_000_000
"""Moments of the past that a new client may need: the newest frame, and those of a stream that goes on."""

_ADVANCE_US: Final = 100_000
_WAITING_US: Final = 10_000
"""How often the scene is advanced, and how often while little of it is in memory."""

_DEFAULT_PERIOD_US: Final = 10_000

_log = logging.getLogger(__name__)


class OpenPass(NamedTuple):
    """A pass that is being read, and the moments that are left of it.

    They are not in TakePass, because a pass and its generator would refer to each other: the take's files
    would stay open until the next garbage collection.
    """

    take_pass: TakePass
    moments: Iterator[Moment]


class _Batch(NamedTuple):
    """Moments that follow each other; ``is_end`` if the pass ends with them, because of ``error`` or not."""

    moments: list[Moment]
    is_end: bool
    error: TakeError | None = None


class TakePlayback:
    """The frames and parameters of a take during one measurement, which starts again after its end.

    ``thread`` reads ahead. If the disk is too slow, the rest of the take waits for it.
    """

    def __init__(self, played: PlayedSource, first_pass: OpenPass, thread: WorkerThread) -> None:
        self._played = played
        self._thread = thread
        self._frames: weakref.WeakSet[RecordedFrames] = weakref.WeakSet()  # those that clients have
        self._pass: OpenPass | None = first_pass  # None at the end of all: the take cannot be read any more
        self._is_pass_begun = False
        self._pass_start_us = 0
        self._reading: Future[_Batch] | None = None
        self._ahead: deque[Moment] = deque()
        self._ahead_bytes = 0
        self._past: deque[Moment] = deque()  # the newest one is kept until the next one
        self.length_us: int | None = None
        """The length of the first pass; None until it has been read."""

    @property
    def parameters(self) -> RecordedParameters:
        """The parameters of the present frame."""
        return self._past[-1].parameters if self._past else self._played.default

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> RecordedFrames:
        """See Scene."""
        frames = RecordedFrames(components, event_bytes, self._played.rates_hz)
        frames.add([*self._past, *self._ahead], is_end=False)
        self._frames.add(frames)
        return frames

    def advance(self, elapsed_us: int) -> int:
        """See Scene."""
        reading = self._reading
        if reading is not None and reading.done():
            self._reading = None
            self._take_batch(reading.result(), elapsed_us)
        while self._ahead and self._ahead[0].due_us <= elapsed_us:
            moment = self._ahead.popleft()
            self._ahead_bytes -= moment.num_bytes
            self._past.append(moment)
        while len(self._past) > 1 and self._past[1].due_us < elapsed_us - _KEPT_US:
            self._past.popleft()
        for frames in self._frames:
            frames.forget(elapsed_us - 2 * LATE_US)
        self.read_on(elapsed_us)
        is_waiting = self._reading is not None and self._last_us < elapsed_us + _AHEAD_US // 2
        return elapsed_us + (_WAITING_US if is_waiting else _ADVANCE_US)

    def read_on(self, elapsed_us: int) -> None:
        """Let the thread read the next batch, if there is room for it."""
        is_short = self._last_us < elapsed_us + _AHEAD_US and self._ahead_bytes < _MAX_AHEAD_BYTES
        if self._reading is None and is_short and self._pass is not None:
            moments = self._pass.moments
            self._reading = self._thread.submit(lambda: _read_batch(moments))

    @property
    def _last_us(self) -> int:
        """The time of the newest moment that has been read; 0 before the first."""
        newest = self._ahead or self._past
        return newest[-1].due_us if newest else 0

    def _take_batch(self, batch: _Batch, elapsed_us: int) -> None:
        """Put a batch that has been read into its place in time."""
        if batch.moments:
            late_us = elapsed_us - (self._pass_start_us + batch.moments[0].due_us)
            if late_us > 0 and not (self._is_pass_begun and late_us < LATE_US // 2):
                self._pass_start_us += late_us  # the take waits for the disk
            self._is_pass_begun = True
            for moment in batch.moments:
                moment.due_us += self._pass_start_us
                self._ahead_bytes += moment.num_bytes
            self._ahead.extend(batch.moments)
        for frames in self._frames:
            frames.add(batch.moments, is_end=batch.is_end)
        if batch.is_end:
            self._end_pass(batch.error)

    def _end_pass(self, error: TakeError | None) -> None:
        """Go on with the next pass, which follows after the longest period of a component."""
        rates_hz = self._played.rates_hz.values()
        length_us = self._last_us + (round(1e6 / min(rates_hz)) if rates_hz else _DEFAULT_PERIOD_US)
        if self.length_us is None:
            self.length_us = length_us
        if error is not None:
            _log.error("The take cannot be read any further, and ends here: %s", error)
        elif self._pass is not None and not self._played.is_reported:
            self._played.is_reported = True
            _report(self._played.reader, self._pass.take_pass.num_malformed)
        can_go_on = error is None and self._is_pass_begun
        self._pass = open_pass(self._played) if can_go_on else None
        self._pass_start_us = length_us
        self._is_pass_begun = False


def open_pass(played: PlayedSource) -> OpenPass:
    """Return a new pass at its beginning."""
    take_pass = TakePass(played)
    return OpenPass(take_pass, take_pass.moments())


def _read_batch(moments: Iterator[Moment]) -> _Batch:
    batch: list[Moment] = []
    num_bytes = 0
    try:
        for moment in moments:
            batch.append(moment)
            num_bytes += moment.num_bytes
            if num_bytes > _BATCH_BYTES or len(batch) == _BATCH_MOMENTS:
                return _Batch(batch, is_end=False)
    except TakeError as error:
        return _Batch(batch, is_end=True, error=error)
    return _Batch(batch, is_end=True)


def _report(reader: TakeReader, num_malformed: int) -> None:
    """Log what the first complete pass could not play."""
    num_damaged = sum(log.num_damaged for log in reader.logs)
    num_bytes = sum(log.damaged_bytes for log in reader.logs)
    num_unknown = reader.unknown.total()
    if num_damaged or num_unknown or num_malformed:
        _log.warning(
            "%s is not complete: %d damaged places (%d bytes), %d messages of an unknown type, and %d "
            "malformed messages are left out",
            safe_text(str(reader.path)),
            *(num_damaged, num_bytes, num_unknown, num_malformed),
        )
