"""A take as a scene: which source of it is played, and with which parameters."""

import logging
from collections import Counter
from collections.abc import Sequence
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path
from statistics import median_low
from typing import Final

from gateway.errors import SelectionError, TakeError
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.parameters import General, Parameters
from gateway.rtc3d.parameters_xml import cut_sections
from gateway.runtime.safe_text import quoted, safe_text
from gateway.runtime.workers import WorkerThread
from gateway.simulator.take_frames import RecordedFrames
from gateway.simulator.take_moments import Moment, derived_parameters
from gateway.simulator.take_pass import PlayedSource, TakePass
from gateway.simulator.take_playback import OpenPass, TakePlayback, open_pass
from gateway.takes.files.reader import TakeReader

_PREVIEW_MOMENTS: Final = 3000
"""Without parameters, the numbers of items and the rates are those of this many moments at the beginning."""

_SOURCES_WITHIN: Final = 20_000
"""Each source of a take has a message among this many at its beginning."""

_LEAST_SHARE: Final = 0.005

_SAME_RATE: Final = 1.2

_log = logging.getLogger(__name__)


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
        reader = TakeReader(path)
        self._played = PlayedSource(reader, _chosen_source(reader, source))
        if from_s is not None:
            self._played.first_utime = reader.start_utime + round(from_s * 1e6)
        if to_s is not None:
            self._played.end_utime = reader.start_utime + round(to_s * 1e6)
        first_pass = TakePass(self._played)
        moments = first_pass.moments()
        preview = list(islice(moments, _PREVIEW_MOMENTS))
        if not preview:
            text = f"{safe_text(str(path))} has no frames of {safe_text(self._played.source)}"
            if from_s is not None or to_s is not None:
                text += " from " + ("the beginning" if from_s is None else f"{from_s:g} s")
                text += " to " + ("its end" if to_s is None else f"{to_s:g} s")
            raise SelectionError(f"{text}; rtc3d-gateway take info shows what is in it")
        self._played.rates_hz = _rates_hz(preview)
        if first_pass.first_parameters is not None:
            self._played.default = first_pass.first_parameters
        else:
            self._played.default = derived_parameters(preview, self._played.rates_hz)
            _log.warning(
                "%s has no parameters of %s at its beginning; the simulator serves minimal ones, with the "
                "numbers of items and the rates of the first frames, and numbers as labels",
                *(safe_text(str(path)), safe_text(self._played.source)),
            )
        if self._played.source in reader.cut_off_sources():
            _log.warning(
                "%s is not complete: the recording of %s was cut off, so its end is missing",
                *(safe_text(str(path)), safe_text(self._played.source)),
            )
        for moment in preview:
            if not moment.parameters.xml:
                moment.parameters = self._played.default
        # The first measurement goes on from here, because it can take long to find the beginning of a range.
        self._prepared: OpenPass | None = OpenPass(first_pass, chain(preview, moments))
        self._thread = WorkerThread("take")
        self._playback = self._new_playback()

    def _new_playback(self, first_pass: OpenPass | None = None) -> TakePlayback:
        """Return the playback of a measurement, with a new pass unless one is open already."""
        return TakePlayback(self._played, first_pass or open_pass(self._played), self._thread)

    # Scene ----------------------------------------------------------------------------------

    @property
    def parameters(self) -> Parameters:
        """See Scene."""
        return self._playback.parameters.parsed

    @property
    def length_us(self) -> int | None:
        """See Scene."""
        return self._playback.length_us

    def parameters_xml(self, sections: Sequence[str], general: General) -> bytes:  # noqa: ARG002 - as recorded
        """See Scene. General is that of the recorded server."""
        recorded = self._playback.parameters
        return cut_sections(recorded.xml, recorded.parsed, sections)

    def start(self) -> None:
        """See Scene."""
        self._playback = self._new_playback(self._prepared)
        self._prepared = None
        self._playback.read_on(0)

    def advance(self, elapsed_us: int) -> int | None:
        """See Scene."""
        return self._playback.advance(elapsed_us)

    def stop(self) -> None:
        """See Scene."""
        self._playback = self._new_playback()

    def frames(self, components: Sequence[ComponentType], event_bytes: int) -> RecordedFrames:
        """See Scene."""
        return self._playback.frames(components, event_bytes)


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
