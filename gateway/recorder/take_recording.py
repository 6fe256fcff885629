"""A recording of what gateways publish: from the messages that arrive to the thread that writes them."""

import functools
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import Final

from gateway.messages.encode import VERSION_OFFSET
from gateway.messages.host_time import now_utime
from gateway.messages.topics import MAX_CHANNEL_LENGTH, unique_name
from gateway.outputs.contract import ServerParameters
from gateway.outputs.parameters_message import encode_parameters, published_again
from gateway.recorder.file_sink import FileSink
from gateway.recorder.series import RecordedSeries, RecordedSource
from gateway.takes.description import encode_take
from gateway.takes.recording import MAX_QUEUED_BYTES, Recorder

MAX_SOURCES: Final = 64
MAX_SERIES: Final = 4096
"""The most sources, and keys of all sources together, in a recording. Names come from the network."""

MAX_XML_BYTES: Final = 16 * 1024 * 1024

_MIN_UTIME: Final = -(1 << 63)
_VERSION: Final = slice(VERSION_OFFSET, None)
"""The part of a ``parameters_t`` by which it is known: its version and its XML."""


class TakeRecording:
    """Records messages in the order of their arrival. Each source is described before its first message.

    ``open_file`` creates the file; it takes the names of the sources, and is called when the first of them
    can be described. Until then, and for ``start_s`` at least, all messages wait in memory, so that the file
    begins with the descriptions. A source that appears later has its own description then.

    ``receive`` and the methods for answers may be called in several threads; ``tick`` and ``close`` in one.
    """

    def __init__(
        self,
        open_file: Callable[[list[str]], FileSink],
        components: Collection[str] | None = None,
        start_s: float = 0.0,
    ) -> None:
        self.sources: dict[str, RecordedSource] = {}
        """By the beginning of their channels."""
        self.sink: FileSink | None = None
        """The file, after it was created."""
        self.num_foreign = 0
        """How many messages were not recorded, because they are none of a gateway."""
        self.num_beyond = 0
        """How many messages were not recorded, because there are too many sources or keys."""
        self.defect: Exception | None = None
        """The first defect of this program; ``num_defects`` messages were not recorded because of such."""
        self.num_defects = 0
        self.first_heard_s: float | None = None
        """When the first message arrived, on the monotonic clock; None before."""
        self.is_moved = False
        """Whether somebody has moved or deleted the file; known after ``close``."""
        self._open_file = open_file
        self._components = components
        self._lock = threading.Lock()
        self._recorder = Recorder("record")
        self._held: deque[tuple[RecordedSeries, bytes]] = deque()
        self._held_bytes = 0
        self._is_starting = True
        self._start_end_s = time.monotonic() + start_s
        self._num_series = 0
        self._is_closed = False

    @property
    def queued_bytes(self) -> int:
        """How many bytes are not written yet."""
        return self._recorder.queued_bytes + self._held_bytes

    @property
    def sources_now(self) -> list[RecordedSource]:
        """The sources so far."""
        with self._lock:
            return [*self.sources.values()]

    @property
    def all_series(self) -> list[RecordedSeries]:
        """The series of all sources so far."""
        with self._lock:
            return [series for source in self.sources.values() for series in source.series]

    @property
    def num_messages(self) -> int:
        """How many messages have arrived to be recorded."""
        return sum(series.num_messages for series in self.all_series if series.is_recorded)

    @property
    def num_bytes(self) -> int:
        """How many bytes these are."""
        return sum(series.num_bytes for series in self.all_series if series.is_recorded)

    # What is recorded. Any thread.

    def source(self, name: str, channels: str, *, is_known: bool) -> RecordedSource | None:
        """Return the source ``name``, new or not, whose channels begin with ``channels``; None if too many.

        If its name ``is_known``, other names have other channels.
        """
        with self._lock:
            if is_known:
                found = next((each for each in self.sources.values() if each.name == name), None)
                channels = unique_name(channels, self.sources) if found is None else found.channels
            source = self.sources.get(channels)
            if source is None and len(self.sources) < MAX_SOURCES:
                source = self.sources[channels] = RecordedSource(name, channels)
            return source

    def series(self, source: RecordedSource, key: str, channel: str) -> RecordedSeries | None:
        """Return the series of a key, new or not, on this channel or a similar one; None if too many."""
        with self._lock:
            return self._find_series(source, key, channel)

    def _find_series(self, source: RecordedSource, key: str, channel: str) -> RecordedSeries | None:
        series = source.series_by_key.get(key)
        if series is None and self._num_series < MAX_SERIES:
            taken = {each.channel.decode() for each in source.series}
            free = unique_name(channel, taken, MAX_CHANNEL_LENGTH)
            series = RecordedSeries(source, key, free, is_recorded=self._is_wanted(key))
            source.series_by_key[key] = series
            self._num_series += 1
        return series

    def _is_wanted(self, key: str) -> bool:
        if self._components is None or key == "parameters":
            return True
        return key.partition("/")[0] in self._components

    # Messages and answers. Any thread.

    def receive(self, series: RecordedSeries, message: bytes) -> None:
        """Record a message."""
        with self._lock:
            if self._is_closed:
                return
            if not series.accepts(message):
                self.num_foreign += 1
                return
            series.count(message)
            source = series.source
            self._hear(source)
            if series.key == "status":
                source.status = message
            if series.is_recorded:
                self._put(series, message)

    def ignore(self, *, beyond_limit: bool) -> None:
        """Count a message that is not recorded."""
        with self._lock:
            self.num_foreign += not beyond_limit
            self.num_beyond += beyond_limit

    def failed(self, defect: Exception) -> None:
        """Note a defect in this program: a message is not recorded, but the others are."""
        with self._lock:
            self.defect = self.defect or defect
            self.num_defects += 1

    def receive_parameters(self, series: RecordedSeries, message: bytes, *, is_made: bool) -> None:
        """Record a ``parameters_t``, published or ``is_made`` here, unless it repeats the newest one."""
        with self._lock:
            source = series.source
            source.has_answer = True
            self._hear(source)
            former = source.parameters
            if self._is_closed or (former is not None and former[_VERSION] == message[_VERSION]):
                return
            source.parameters = message
            if former is not None or source.is_described:
                series.add(message)
                self._put(series, message)
            else:
                source.first_parameters, source.has_made_first = message, is_made

    def parameters_message(
        self, source: RecordedSource, xml: bytes, session: int | None, version: int, age_s: float = 0.0
    ) -> bytes:
        """Return parameters from Zenoh, or from an answer, as ``parameters_t``.

        Its times are on the gateway's clock, as far as its messages show.
        """
        with self._lock:
            utime = source.last_utime or now_utime()
            parameters = ServerParameters(xml, source.session if session is None else session, version)
            sequence, source.num_parameters = source.num_parameters, source.num_parameters + 1
        arrived_utime = max(utime - round(1e6 * age_s), _MIN_UTIME)
        return encode_parameters(parameters, utime=utime, arrived_utime=arrived_utime, sequence=sequence)

    def answered(self, source: RecordedSource, parameters: bytes | None) -> None:
        """Take the answer to the query for the parameters; None if there are none."""
        with self._lock:
            source.has_answer = True
            if parameters is not None and source.parameters is None and not source.is_described:
                source.parameters = source.first_parameters = parameters
                source.has_made_first = True

    def answered_status(self, source: RecordedSource, message: bytes) -> None:
        """Take the answer to a query for the status."""
        with self._lock:
            source.status = source.status or message

    def _hear(self, source: RecordedSource) -> None:
        source.heard_s = time.monotonic()
        if self.first_heard_s is None:
            self.first_heard_s = source.heard_s

    def _put(self, series: RecordedSeries, message: bytes) -> None:
        if self._is_starting or not series.source.is_described:
            if self._held_bytes + len(message) > MAX_QUEUED_BYTES:
                series.num_refused += 1
                return
            self._held.append((series, message))
            self._held_bytes += len(message)
        elif self.sink is None or not self._recorder.record(self.sink, series.channel, message):
            series.num_refused += 1

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
            self.sink.close()
        return True
