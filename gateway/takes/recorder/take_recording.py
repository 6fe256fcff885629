"""A recording of what gateways publish: from the messages that arrive to the thread that writes them."""

import functools
import math
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import Final

from gateway.client.reception import Reception
from gateway.client.series import Series, Source
from gateway.messages.host_time import now_utime
from gateway.outputs.parameters_message import published_again
from gateway.takes.files.description import (
    NO_DETAILS,
    TakeDetails,
    encode_take,
    encode_take_details,
    encode_take_end,
)
from gateway.takes.files.recording import MAX_QUEUED_BYTES, Recorder
from gateway.takes.recorder.target import FileSink

_WAIT_S: Final = 1.5
"""How long the messages of a new source wait for its description; each second brings a status."""


class RecordedSeries(Series):
    """The messages of one key of a source."""

    source: "RecordedSource"

    def __init__(self, source: "RecordedSource", key: str, channel: str, *, is_recorded: bool) -> None:
        super().__init__(source, key, channel)
        self.is_recorded = is_recorded
        """Whether its messages are recorded. Those of others only describe the source."""
        self.num_refused = 0
        """How many of them were not written, because too many waited for the disk."""
        self.num_refused_bytes = 0

    def refuse(self, message: bytes) -> None:
        """Count a message that is not written."""
        self.num_refused += 1
        self.num_refused_bytes += len(message)


class RecordedSource(Source):
    """A source of the recording. ``channels`` is the beginning of its channels in the file."""

    def __init__(self, name: str, channels: str) -> None:
        super().__init__(name, channels)
        self.first_parameters: bytes | None = None
        """The first one, which belongs to the description."""
        self.has_made_first = False
        """Whether this program has made that message, and no gateway."""
        self.is_described = False
        """Whether its description is in the file. Before that, its messages wait."""

    @property
    def is_waiting(self) -> bool:
        """Whether something that the description needs is still to come."""
        is_complete = self.heard_s is not None and not super().is_waiting
        return not (self.is_described or is_complete or time.monotonic() - self.found_s > _WAIT_S)

    def stop_waiting(self) -> None:
        """Describe the source by what is known now."""
        self.found_s = -math.inf

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
        open_file: Callable[[list[str]], FileSink],
        components: Collection[str] | None = None,
        start_s: float = 0.0,
        details: TakeDetails = NO_DETAILS,
    ) -> None:
        super().__init__()
        self.sink: FileSink | None = None
        """The file, after it was created."""
        self.is_moved = False
        """Whether somebody has moved or deleted the file; known after ``close``."""
        self._open_file = open_file
        self._components = components
        self._details = details
        self._recorder = Recorder("record")
        self._held: deque[tuple[RecordedSeries, bytes]] = deque()
        self._held_bytes = 0
        self._is_starting = True
        self._start_end_s = time.monotonic() + start_s

    @property
    def queued_bytes(self) -> int:
        """How many bytes are not written yet."""
        return self._recorder.queued_bytes + self._held_bytes

    @property
    def num_messages(self) -> int:
        """How many messages have arrived to be recorded."""
        return sum(series.num_messages for series in self.all_series if series.is_recorded)

    @property
    def num_bytes(self) -> int:
        """How many bytes these are."""
        return sum(series.num_bytes for series in self.all_series if series.is_recorded)

    # Messages and answers. Any thread.

    def _new_source(self, name: str, channels: str) -> RecordedSource:
        return RecordedSource(name, channels)

    def _new_series(self, source: RecordedSource, key: str, channel: str) -> RecordedSeries:
        return RecordedSeries(source, key, channel, is_recorded=self._is_wanted(key))

    def _is_wanted(self, key: str) -> bool:
        if self._components is None or key == "parameters":
            return True
        return key.partition("/")[0] in self._components

    def _take(self, series: RecordedSeries, message: bytes) -> None:
        if series.is_recorded:
            self._put(series, message)

    def _take_parameters(
        self, series: RecordedSeries, message: bytes, *, is_first: bool, is_made: bool
    ) -> None:
        source = series.source
        if is_first and not source.is_described:
            source.first_parameters, source.has_made_first = message, is_made
        else:
            series.add(message)
            self._put(series, message)

    def _take_answer(self, source: RecordedSource, parameters: bytes) -> None:
        if not source.is_described:
            source.parameters = source.first_parameters = parameters
            source.has_made_first = True

    def _put(self, series: RecordedSeries, message: bytes) -> None:
        if self._is_starting or not series.source.is_described:
            if self._held_bytes + len(message) > MAX_QUEUED_BYTES:
                series.refuse(message)
                return
            self._held.append((series, message))
            self._held_bytes += len(message)
        elif self.sink is None or not self._recorder.record(self.sink, series.channel, message):
            series.refuse(message)

    # Descriptions. One thread.

    def tick(self) -> None:
        """Describe the sources for which it is time, and record their messages. Call it often.

        Raises TakeError if the file cannot be created.
        """
        with self._lock:
            heard = self._heard()
            if self._is_starting:
                if not heard or time.monotonic() < self._start_end_s:
                    return
                if any(source.is_waiting for source in self.sources.values()):
                    return
        self._begin(heard)

    def _heard(self) -> list[str]:
        return sorted(source.name for source in self.sources.values() if source.heard_s is not None)

    def _begin(self, sources: list[str]) -> None:
        if self.sink is None:
            self.sink = self._open_file(sources)  # not under the lock: the disk may be slow
        with self._lock:
            self._is_starting = False
            for source in self.sources.values():
                if source.heard_s is not None and not (source.is_described or source.is_waiting):
                    self._describe(source)
            self._release()

    def _describe(self, source: RecordedSource) -> None:
        assert self.sink is not None  # noqa: S101 - see _begin
        status = source.decoded_status()
        utime = source.first_utime or now_utime()
        take = encode_take(
            utime=utime,
            name=self.sink.path.stem,
            source=source.name,
            channels=source.channels,
            server=status.server if status is not None else "",
            gateway_version=status.gateway_version if status is not None else "",
            recorder="rtc3d-gateway record",
        )
        description = [(f"{source.channels}_TAKE".encode(), take)]
        if self._details != NO_DETAILS:
            about = encode_take_details(utime=utime, source=source.name, details=self._details)
            description.append((f"{source.channels}_DETAILS".encode(), about))
        parameters = source.first_parameters
        series = self._find_series(source, "parameters", f"{source.channels}_PARAMETERS")
        if parameters is not None and series is not None:
            if source.has_made_first:
                parameters = published_again(parameters, utime)
            series.add(parameters)
            description.append((series.channel, parameters))
        self._recorder.call(functools.partial(self.sink.write, description))
        source.is_described = True

    def _release(self) -> None:
        """Record what has waited for the description of its source."""
        held, self._held, self._held_bytes = self._held, deque(), 0
        for series, message in held:
            self._put(series, message)

    # The end. One thread.

    def stop(self) -> None:
        """Record nothing more that arrives, but everything that has. Raises TakeError as ``tick`` does."""
        with self._lock:
            self._is_closed = True
            for source in self.sources.values():
                source.stop_waiting()
            heard = self._heard()
        if heard:
            self._begin(heard)

    def close(self, timeout_s: float) -> bool:
        """Write what waits, and close the file. Return False if the disk needs longer than ``timeout_s``."""
        if not self._recorder.close(timeout_s):
            return False
        if self.sink is not None:
            self.is_moved = not self.sink.is_in_place
            self.sink.end(functools.partial(self._ends, self.sink))
            self.sink.close()
        return True

    def _ends(self, sink: FileSink, num_removed: int) -> list[tuple[bytes, bytes]]:
        """Return the end of each source; ``num_removed`` further losses are counted with the first."""
        utime = now_utime()
        ends: list[tuple[bytes, bytes]] = []
        for source in self.sources.values():
            if source.is_described:
                recorded = [series for series in source.series if series.is_recorded]
                num_lost = sum(series.num_refused + sink.lost[series.channel] for series in recorded)
                num_lost += 0 if ends else num_removed
                end = encode_take_end(utime=utime, source=source.name, messages_lost=num_lost)
                ends.append((f"{source.channels}_END".encode(), end))
        return ends
