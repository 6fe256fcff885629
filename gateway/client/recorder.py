"""Recording what gateways publish, as one of their subscribers: from the messages that arrive to the file."""

import contextlib
import functools
import heapq
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Final

from typing_extensions import override

from gateway.client.reception import Reception
from gateway.client.sources import ReceivedSeries, ReceivedSource
from gateway.errors import SelectionError, TakeError
from gateway.messages.history import utime_of
from gateway.messages.host_time import now_utime
from gateway.messages.take_names import default_name, numbered
from gateway.outputs.contract import published_again
from gateway.takes.files.description import NO_DETAILS, SourceDescription, TakeDetails
from gateway.takes.files.reader import SUFFIX
from gateway.takes.files.take_writer import Messages, TakeWriter
from gateway.takes.files.writer_thread import MAX_QUEUED_BYTES, LogFile, WriterThread

_WAIT_S: Final = 1.5
"""How long the messages of a new source wait for its description; each second brings a status."""


_MAX_EARLY_BYTES: Final = 16 * 1024 * 1024
"""How much waits for earlier messages. What is beyond comes before them in the file."""


class RecordedSeries(ReceivedSeries):
    """The messages of one key of a source."""

    source: "RecordedSource"

    def __init__(self, source: "RecordedSource", key: str, channel: str, *, is_recorded: bool) -> None:
        super().__init__(source, key, channel)
        self.is_recorded = is_recorded
        """Whether its messages are recorded. Those of others only describe the source."""
        self.num_refused = 0
        """How many of them were not written, because too many waited for the disk."""
        self.num_refused_bytes = 0
        self.merged_utime = 0
        """The time of the newest message, which orders it among those of other series."""


class RecordedSource(ReceivedSource):
    """A source of the recording. ``channels`` is the beginning of its channels in the file."""

    def __init__(self, name: str, channels: str, monotonic: Callable[[], float]) -> None:
        super().__init__(name, channels, monotonic)
        self.first_parameters: bytes | None = None
        """The first one, which belongs to the description."""
        self.has_made_first = False
        """Whether this program has made that message, and no gateway."""
        self.description: SourceDescription | None = None
        """What the file says of it; None before that, when its messages wait."""
        self.early: list[tuple[int, int, RecordedSeries, bytes]] = []
        """A heap of messages that wait for those of before, which other series miss: time, number, …"""

    @property
    def is_waiting(self) -> bool:
        """Whether something that the description needs is still to come."""
        is_complete = self.heard_s is not None and not super().is_waiting
        is_late = self._monotonic() - self.found_s > _WAIT_S
        return self.description is None and not (is_complete or is_late)

    @property
    def num_data(self) -> int:
        """How many messages of frames have arrived to be recorded."""
        return sum(each.num_messages for each in self.series if each.has_data and each.is_recorded)


class TakeRecording(Reception[RecordedSource, RecordedSeries]):
    """Records messages in the order of their arrival. Each source is described before its first message.

    ``open_file`` creates the file; it takes the names of the sources, and is called when the first of them
    can be described. Until then, and for ``start_s`` at least, all messages wait in memory, so that the file
    begins with the descriptions. A source that appears later has its own description then.

    ``tick``, ``stop`` and ``close`` are called in one thread.
    """

    def __init__(
        self,
        open_file: Callable[[list[str]], "FileWriter"],
        components: Collection[str] | None = None,
        start_s: float = 0.0,
        details: TakeDetails = NO_DETAILS,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(monotonic)
        self.file: FileWriter | None = None
        """The file, after it was created."""
        self.is_moved = False
        """Whether somebody has moved or deleted the file; known after ``close``."""
        self._open_file = open_file
        self._components = components
        self._details = details
        self._writer = WriterThread("record")
        self._held: deque[tuple[RecordedSeries, bytes]] = deque()
        self._held_bytes = 0
        self._num_early = 0  # so far
        self._early_bytes = 0
        self._is_starting = True
        self._start_end_s = monotonic() + start_s

    @property
    def queued_bytes(self) -> int:
        """How many bytes are not written yet."""
        return self._writer.queued_bytes + self._held_bytes + self._early_bytes

    @property
    def num_messages(self) -> int:
        """How many messages have arrived to be recorded."""
        return sum(series.num_messages for series in self.all_series if series.is_recorded)

    @property
    def num_bytes(self) -> int:
        """How many bytes these are."""
        return sum(series.num_bytes for series in self.all_series if series.is_recorded)

    # Messages and answers. Any thread.

    @property
    @override
    def has_room(self) -> bool:
        """What arrives needs the rest of the queue while the disk is slow."""
        return self.queued_bytes - self._early_bytes < MAX_QUEUED_BYTES // 16

    def _completes(self, series: RecordedSeries) -> bool:
        return series.is_recorded and super()._completes(series)

    def _new_source(self, name: str, channels: str) -> RecordedSource:
        return RecordedSource(name, channels, self.monotonic)

    def _new_series(self, source: RecordedSource, key: str, channel: str) -> RecordedSeries:
        is_wanted = self._components is None or key.partition("/")[0] in {*self._components, "parameters"}
        return RecordedSeries(source, key, channel, is_recorded=is_wanted)

    def _take(self, series: RecordedSeries, message: bytes) -> None:
        if series.is_recorded:
            self._put_in_order(series, message)

    def _put_in_order(self, series: RecordedSeries, message: bytes) -> None:
        """Put a message when no series of the source misses one of before any more.

        A replay follows the file, and takes a message of long before for a clock that was set back.
        """
        series.merged_utime = max(series.merged_utime, utime_of(message))
        early = series.source.early
        if not early and self._reached_utime(series.source) == math.inf:
            self._put(series, message)
            return
        self._num_early += 1
        heapq.heappush(early, (series.merged_utime, self._num_early, series, message))
        self._early_bytes += len(message)
        self._put_early(series.source)

    def _put_early(self, source: RecordedSource, *, is_end: bool = False) -> None:
        early, reached_utime = source.early, self._reached_utime(source)
        while early and (is_end or early[0][0] <= reached_utime or self._early_bytes > _MAX_EARLY_BYTES):
            _, _, series, message = heapq.heappop(early)
            self._early_bytes -= len(message)
            self._put(series, message)

    def _reached_utime(self, source: RecordedSource) -> float:
        return math.inf if self.refill is None else self.refill.reached_utime(source)

    def _take_parameters(
        self, series: RecordedSeries, message: bytes, *, is_first: bool, is_made: bool
    ) -> None:
        source = series.source
        if is_first and source.description is None:
            source.first_parameters, source.has_made_first = message, is_made
        else:
            series.add(message)
            self._put(series, message)

    def _take_answer(self, source: RecordedSource, parameters: bytes) -> None:
        if source.description is None:
            source.parameters = source.first_parameters = parameters
            source.has_made_first = True

    def _put(self, series: RecordedSeries, message: bytes) -> None:
        must_wait = self._is_starting or series.source.description is None
        if must_wait and self._held_bytes + len(message) <= MAX_QUEUED_BYTES:
            self._held.append((series, message))
            self._held_bytes += len(message)
        elif must_wait or self.file is None or not self._writer.record(self.file, series.channel, message):
            series.num_refused += 1
            series.num_refused_bytes += len(message)

    # Descriptions. One thread.

    def tick(self) -> None:
        """Describe the sources for which it is time, and record their messages. Call it often.

        Raises TakeError if the file cannot be created.
        """
        with self._lock:
            heard = self._heard()
            for source in self.sources.values():
                self._put_early(source)
            if self._is_starting:
                if not heard or self.monotonic() < self._start_end_s:
                    return
                if any(source.is_waiting for source in self.sources.values()):
                    return
        self._begin(heard)

    def _heard(self) -> list[str]:
        return sorted(source.name for source in self.sources.values() if source.heard_s is not None)

    def _begin(self, sources: list[str]) -> None:
        if self.file is None:
            self.file = self._open_file(sources)  # not under the lock: the disk may be slow
        with self._lock:
            self._is_starting = False
            for source in self.sources.values():
                is_heard = source.heard_s is not None and source.description is None
                if is_heard and not source.is_waiting:
                    self._describe(source)
            held, self._held, self._held_bytes = self._held, deque(), 0
            for series, message in held:  # what has waited for the description of its source
                self._put(series, message)

    def _describe(self, source: RecordedSource) -> None:
        assert self.file is not None  # noqa: S101 - see _begin
        status = source.decoded_status()
        utime = source.first_utime or now_utime()
        source.description = description = SourceDescription(
            source.name,
            source.channels,
            status.server if status is not None else "",
            status.gateway_version if status is not None else "",
            "rtc3d-gateway record",
            self._details,
        )
        messages = description.beginning(self.file.path.stem, utime)
        parameters = source.first_parameters
        series = self._find_series(source, "parameters", f"{source.channels}_PARAMETERS")
        if parameters is not None and series is not None:
            if source.has_made_first:
                parameters = published_again(parameters, utime)
            series.add(parameters)
            messages.append((series.channel, parameters))
        self._writer.call(functools.partial(self.file.write, messages))

    # The end. One thread.

    def stop(self) -> None:
        """Record nothing more that arrives, but everything that has. Raises TakeError as ``tick`` does."""
        with self._lock:
            self._is_closed = True
            for source in self.sources.values():
                self._put_early(source, is_end=True)
                source.found_s = -math.inf  # describe it by what is known now
            heard = self._heard()
        if heard:
            self._begin(heard)

    def close(self, timeout_s: float) -> bool:
        """Write what waits, and close the file. Return False if the disk needs longer than ``timeout_s``."""
        if not self._writer.close(timeout_s):
            return False
        if self.file is not None:
            self.is_moved = not self.file.is_in_place
            self.file.end_log(functools.partial(self._ends, self.file))
        return True

    def _ends(self, sink: "FileWriter", num_removed: int) -> Messages:
        """Return the end of each source; ``num_removed`` further losses are counted with the first."""
        utime = now_utime()
        ends: list[tuple[bytes, bytes]] = []
        for source in self.sources.values():
            if source.description is not None:
                recorded = [series for series in source.series if series.is_recorded]
                num_lost = sum(series.num_refused + sink.lost[series.channel] for series in recorded)
                ends.append(source.description.end(utime, num_lost + (0 if ends else num_removed)))
        return ends


class FileWriter(TakeWriter):
    """Writes the file of a recording, and counts what is not in it by channel. Any thread may read these."""

    def __init__(self, log: LogFile) -> None:
        super().__init__(log.path, log)
        self.problem = ""
        """What is wrong with the disk now; "" if it accepts messages."""
        self.lost: Counter[bytes] = Counter()
        """How many messages the disk has not accepted in the end, by channel."""
        self.lost_bytes: Counter[bytes] = Counter()
        self.num_errors = 0
        """How often the disk stopped accepting messages."""
        self._file = log

    @property
    def is_in_place(self) -> bool:
        """Whether the file still has its path. Do not call it after ``end_log``."""
        return self._file.is_in_place()

    @property
    def num_bytes(self) -> int:
        """The size of the file."""
        return self._file.num_bytes

    @override
    def log_for(self, utime: int) -> LogFile:
        return self._file

    @override
    def succeeded(self) -> None:
        self.problem = ""

    @override
    def failed(self, error: OSError) -> None:
        """A problem counts once, however often the disk is tried."""
        if not self.problem:
            self.num_errors += 1
        self.problem = f"{self.path} cannot be written: {error.strerror or error}"

    @override
    def lose(self, messages: Messages) -> None:
        for channel, message in messages:
            self.lost[channel] += 1
            self.lost_bytes[channel] += len(message)

    def lose_newest(self, error: OSError) -> None:
        """See TakeWriter: the end of the file counts it, and the problem makes the recording incomplete."""
        self.failed(error)


_MAX_NAMED: Final = 3
"""The default name has the names of at most this many sources."""


class Target:
    """Where to record: a file, which is created at once, or a folder, where the name follows the sources.

    Raises TakeError if nothing can be recorded there.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path
        self._log: LogFile | None = None
        if os.path.isdir(path):  # noqa: PTH112 - also False for a name that is too long: creating it says so
            if not os.access(path, os.W_OK | os.X_OK):
                raise TakeError(f"no permission to write in the folder {path}; choose another one")
        elif path.suffix in {"", SUFFIX}:
            self._log = _create(path.with_suffix(SUFFIX))
        else:
            raise SelectionError(
                f"{path}: recordings are LCM event logs; choose a name that ends with {SUFFIX}, "
                "and convert it afterwards (rtc3d-gateway export)"
            )

    def open(self, sources: Sequence[str]) -> LogFile:
        """Return the new file, named after the sources if it is in a folder. Raises TakeError."""
        name = default_name("+".join(sources) if len(sources) <= _MAX_NAMED else f"{len(sources)}-sources")
        number = 0
        while self._log is None:
            number += 1
            path = self._folder / f"{numbered(name, number)}{SUFFIX}"
            if not os.path.lexists(path):
                self._log = _create(path)
        return self._log

    def discard_empty(self) -> None:
        """Remove the file if nothing was written, so that its name is free for the next attempt."""
        if self._log is not None:
            with contextlib.suppress(OSError):
                if not self._log.path.stat().st_size:
                    self._log.path.unlink()


def _create(path: Path) -> LogFile:
    try:
        return LogFile(path)
    except FileExistsError:
        raise TakeError(
            f"{path} exists already, and nothing is overwritten; choose another name, or a folder"
        ) from None
    except FileNotFoundError as error:
        raise TakeError(f"there is no folder {path.parent}; create it first") from error
    except OSError as error:
        raise TakeError(f"{path} cannot be created: {error.strerror or error}") from error
