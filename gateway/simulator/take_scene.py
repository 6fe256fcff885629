"""A take as a scene: read ahead from its files, while it is played."""

import logging
import weakref
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path
from statistics import median_low
from typing import Final, NamedTuple

from gateway.errors import SelectionError, TakeError
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d.parameters_xml import cut_sections
from gateway.runtime.safe_text import quoted, safe_text
from gateway.runtime.workers import WorkerThread
from gateway.simulator.take_frames import LATE_US, RecordedFrames, TakePass
from gateway.simulator.take_moments import Moment, RecordedParameters, derived_parameters
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

_PREVIEW_MOMENTS: Final = 3000
"""Without parameters, the numbers of items and the rates are those of this many moments at the beginning."""

_SOURCES_WITHIN: Final = 20_000
"""Each source of a take has a message among this many at its beginning."""

_LEAST_SHARE: Final = 0.005

_DEFAULT_PERIOD_US: Final = 10_000
_SAME_RATE: Final = 1.2

_log = logging.getLogger(__name__)


class _Batch(NamedTuple):
    """Moments that follow each other; ``is_end`` if the pass ends with them, because of ``error`` or not."""

    moments: list[Moment]
    is_end: bool
    error: TakeError | None = None


class TakeScene:
    """One source of a take (see Scene), which starts again after its end.

    ``from_s`` and ``to_s`` limit the time of the events, in seconds from the first event of the take. Only
    some seconds of a take are in memory; a thread reads ahead. If the disk is too slow, the rest of the take
    waits for it.
    """

    def __init__(
        self, path: Path, source: str | None = None, *, from_s: float | None = None, to_s: float | None = None
    ) -> None:
        """Read the beginning of the take. Raises TakeError if it cannot be played."""
        self._reader = TakeReader(path)
        self._source = _chosen_source(self._reader, source)
        self._first_utime = None if from_s is None else self._reader.start_utime + round(from_s * 1e6)
        self._end_utime = None if to_s is None else self._reader.start_utime + round(to_s * 1e6)
        self._default = RecordedParameters(b"")
        first_pass = self._new_pass()
        moments = first_pass.moments()
        preview = list(islice(moments, _PREVIEW_MOMENTS))
        if not preview:
            text = f"{safe_text(str(path))} has no frames of {safe_text(self._source)}"
            if from_s is not None or to_s is not None:
                text += " from " + ("the beginning" if from_s is None else f"{from_s:g} s")
                text += " to " + ("its end" if to_s is None else f"{to_s:g} s")
            raise SelectionError(f"{text}; rtc3d-gateway take info shows what is in it")
        self._rates_hz = _rates_hz(preview)
        if first_pass.first_parameters is not None:
            self._default = first_pass.first_parameters
        else:
            self._default = derived_parameters(preview, self._rates_hz)
            _log.warning(
                "%s has no parameters of %s at its beginning; the simulator serves minimal ones, with the "
                "numbers of items and the rates of the first frames, and numbers as labels",
                *(safe_text(str(path)), safe_text(self._source)),
            )
        if self._source in self._reader.cut_off_sources():
            _log.warning(
                "%s is not complete: the recording of %s was cut off, so its end is missing",
                *(safe_text(str(path)), safe_text(self._source)),
            )
        for moment in preview:
            if not moment.parameters.xml:
                moment.parameters = self._default
        first_pass.default = self._default
        # The first measurement goes on from here, because it can take long to find the beginning of a range.
        self._prepared: tuple[TakePass, Iterator[Moment]] | None = (first_pass, chain(preview, moments))
        self._is_reported = False
        self._frames: weakref.WeakSet[RecordedFrames] = weakref.WeakSet()
        self._thread = WorkerThread("take")
        self._reset()

    def _reset(self) -> None:
        """Go to the beginning of the first pass."""
        self._pass = self._new_pass()
        self._moments: Iterator[Moment] = self._pass.moments()
        self._reading: Future[_Batch] | None = None
        self._is_at_end = False  # of all passes, because the take cannot be read any more
        self._is_pass_begun = False
        self._pass_start_us = 0
        self._last_us = 0  # the newest moment that has been read
        self._length_us: int | None = None
        self._ahead: deque[Moment] = deque()
        self._ahead_bytes = 0
        self._past: deque[Moment] = deque()
        self._parameters = self._default

    # Scene ----------------------------------------------------------------------------------

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return self._parameters.parsed

    @property
    def length_us(self) -> int | None:
        """See Scene."""
        return self._length_us

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:  # noqa: ARG002 - as recorded
        """See Scene. General is that of the recorded server."""
        return cut_sections(self._parameters.xml, self._parameters.parsed, sections)

    def start(self) -> None:
        """See Scene."""
        self._reset()
        self._frames.clear()
        if self._prepared is not None:
            self._pass, self._moments = self._prepared
            self._prepared = None
        self._read_on(0)

    def advance(self, elapsed_us: int) -> int | None:
        """See Scene."""
        reading = self._reading
        if reading is not None and reading.done():
            self._reading = None
            self._take_batch(reading.result(), elapsed_us)
        while self._ahead and self._ahead[0].due_us <= elapsed_us:
            moment = self._ahead.popleft()
            self._ahead_bytes -= moment.num_bytes
            self._past.append(moment)
            self._parameters = moment.parameters
        while len(self._past) > 1 and self._past[1].due_us < elapsed_us - _KEPT_US:
            self._past.popleft()
        for frames in self._frames:
            frames.forget(elapsed_us - 2 * LATE_US)
        self._read_on(elapsed_us)
        is_waiting = self._reading is not None and self._last_us < elapsed_us + _AHEAD_US // 2
        return elapsed_us + (_WAITING_US if is_waiting else _ADVANCE_US)

    def stop(self) -> None:
        """See Scene."""
        self._reset()

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> RecordedFrames:
        """See Scene."""
        frames = RecordedFrames(components, event_bytes, self._rates_hz)
        frames.add([*self._past, *self._ahead], is_end=False)
        self._frames.add(frames)
        return frames

    # Reading --------------------------------------------------------------------------------

    def _new_pass(self) -> TakePass:
        return TakePass(self._reader, self._source, self._first_utime, self._end_utime, self._default)

    def _read_on(self, elapsed_us: int) -> None:
        """Let the thread read the next batch, if there is room for it."""
        is_short = self._last_us < elapsed_us + _AHEAD_US and self._ahead_bytes < _MAX_AHEAD_BYTES
        if self._reading is None and is_short and not self._is_at_end:
            moments = self._moments
            self._reading = self._thread.submit(lambda: _read_batch(moments))

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
            self._last_us = batch.moments[-1].due_us
            self._ahead.extend(batch.moments)
        for frames in self._frames:
            frames.add(batch.moments, is_end=batch.is_end)
        if not batch.is_end:
            return
        # The next pass follows after the longest period of a component.
        period_us = round(1e6 / min(self._rates_hz.values())) if self._rates_hz else _DEFAULT_PERIOD_US
        length_us = self._last_us + period_us
        if self._length_us is None:
            self._length_us = length_us
        if batch.error is not None:
            _log.error("The take cannot be read any further, and ends here: %s", batch.error)
        elif not self._is_reported:
            self._is_reported = True
            self._report()
        self._is_at_end = batch.error is not None or not self._is_pass_begun
        self._pass = self._new_pass()
        self._moments = self._pass.moments()
        self._pass_start_us = length_us
        self._is_pass_begun = False

    def _report(self) -> None:
        """Log what the first complete pass could not play."""
        logs = self._reader.logs
        num_damaged, num_bytes = sum(log.num_damaged for log in logs), sum(log.damaged_bytes for log in logs)
        num_unknown = self._reader.unknown.total()
        num_malformed = self._pass.num_malformed
        if num_damaged or num_unknown or num_malformed:
            _log.warning(
                "%s is not complete: %d damaged places (%d bytes), %d messages of an unknown type, and %d "
                "malformed messages are left out",
                safe_text(str(self._reader.path)),
                *(num_damaged, num_bytes, num_unknown, num_malformed),
            )


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


def _chosen_source(reader: TakeReader, source: str | None) -> str:
    """Return the source to play. Raises SelectionError if the take has several, or others only.

    Sources with few messages, compared with the others, do not count: a damaged channel looks like a source.
    """
    counts = Counter(
        message.source
        for message in islice(reader.messages(), _SOURCES_WITHIN)
        if message.key in COMPONENTS_BY_KEY
    )
    names = [name for name, count in counts.items() if count >= _LEAST_SHARE * max(counts.values())]
    path, listed = safe_text(str(reader.path)), safe_text(", ".join(names)) or "none"
    if source is None:
        if len(names) > 1:
            raise SelectionError(f"{path} has several sources: {listed}; choose one with --source")
        if not names:
            raise TakeError(f"{path} has no frames; choose another recording")
        return names[0]
    if source not in counts and all(message.source != source for message in reader.messages()):
        raise SelectionError(f"{path} has no source {quoted(source)}; its sources are: {listed}")
    return source


def _rates_hz(moments: Sequence[Moment]) -> dict[ComponentType, float]:
    """Return the rate of each measured component in these moments that has at least three of them.

    Rates within the factor _SAME_RATE are equal: without time stamps, they have the jitter of the network.
    """
    times_us: dict[ComponentType, list[int]] = {}
    for moment in moments:
        for component in moment.contents:
            times_us.setdefault(component, []).append(moment.due_us)
    measured_hz = {
        component: 1e6 / median_low([later - earlier for earlier, later in pairwise(times)])
        for component, times in times_us.items()
        if component is not ComponentType.EVENT and len(times) > 2
    }
    rates_hz: dict[ComponentType, float] = {}
    slower_hz = 0.0
    for component, rate_hz in sorted(measured_hz.items(), key=itemgetter(1)):
        if rate_hz > slower_hz * _SAME_RATE:
            slower_hz = rate_hz
        rates_hz[component] = slower_hz
    return rates_hz
