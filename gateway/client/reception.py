"""What is received from gateways: by source and key, bounded, with everything that is left out counted."""

import json
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Final, Generic, TypeVar

from gateway.client.completion import Completion
from gateway.client.history_requests import Completeness
from gateway.client.refill import SILENT_S, Ask, FindSeries, Refill
from gateway.client.sources import FIELDS, ReceivedSeries, ReceivedSource
from gateway.messages.encode import FINGERPRINT_BYTES, VERSION_OFFSET
from gateway.messages.host_time import now_utime
from gateway.messages.topics import MAX_CHANNEL_LENGTH, MAX_SOURCES, unique_name
from gateway.outputs.contract import ServerParameters, encode_parameters

MAX_SERIES: Final = 4096
"""The most keys of all sources together: 20 gateways with 5 sources each fit.

Names come from the network.
"""

MAX_XML_BYTES: Final = 16 * 1024 * 1024

_LATE_KEY_US: Final = 1_000_000
"""A key whose first message comes later than that after its source may have had others: each has a status
every second."""

_MIN_UTIME: Final = -(1 << 63)
_VERSION: Final = slice(VERSION_OFFSET, None)
"""The part of a ``parameters_t`` that shows whether it is new: its version and its XML."""

SourceT = TypeVar("SourceT", bound=ReceivedSource)
SeriesT = TypeVar("SeriesT", bound=ReceivedSeries)


class Reception(ABC, Generic[SourceT, SeriesT]):
    """The sources that were received, and their series. All methods may be called in any thread.

    A subclass says what happens with the messages. Its methods ``_new_…`` and ``_take…`` are called under
    ``_lock``.
    """

    takes_poses = True
    """Whether poses of single tools are wanted, which repeat what 6d has. If not, they are not requested."""

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        self.monotonic = monotonic
        """The clock of everything here; seconds."""
        self.sources: dict[str, SourceT] = {}
        """By the beginning of their channels."""
        self.num_foreign = 0
        """How many messages were left out, because no gateway of this version sends such messages."""
        self.num_beyond = 0
        """How many messages were left out, because there are too many sources or keys."""
        self.defect: Exception | None = None
        """The first defect of this program; ``num_defects`` messages were left out because of such."""
        self.num_defects = 0
        self.first_heard_s: float | None = None
        """When the first message arrived, on the monotonic clock; None before."""
        self.refill: Refill | None = None
        """What fills the gaps of all series, if that is wanted."""
        self._lock = threading.Lock()
        self._num_series = 0
        self._is_closed = False

    @property
    def sources_now(self) -> list[SourceT]:
        """The sources so far."""
        with self._lock:
            return [*self.sources.values()]

    @property
    def all_series(self) -> list[SeriesT]:
        """The series of all sources so far."""
        with self._lock:
            return [series for source in self.sources.values() for series in source.series]

    # What is received.

    def source(self, name: str, channels: str, *, is_known: bool) -> SourceT | None:
        """Return the source ``name``, new or not, whose channels begin with ``channels``; None if too many.

        If its name ``is_known``, other names have other channels.
        """
        with self._lock:
            if is_known:
                found = next((each for each in self.sources.values() if each.name == name), None)
                channels = unique_name(channels, self.sources) if found is None else found.channels
            source = self.sources.get(channels)
            if source is None and len(self.sources) < MAX_SOURCES:
                source = self.sources[channels] = self._new_source(name, channels)
            return source

    def series(self, source: SourceT, key: str, channel: str) -> SeriesT | None:
        """Return the series of a key, new or not, on this channel or a similar one; None if too many."""
        with self._lock:
            return self._find_series(source, key, channel)

    def _find_series(self, source: SourceT, key: str, channel: str) -> SeriesT | None:
        series: SeriesT | None = source.series_by_key.get(key)
        if series is None and self._num_series < MAX_SERIES:
            taken = {each.channel.decode() for each in source.series}
            free = unique_name(channel, taken, MAX_CHANNEL_LENGTH)
            series = source.series_by_key[key] = self._new_series(source, key, free)
            self._num_series += 1
            if self.refill is not None:
                self.refill.begin(source)
                if self._completes(series):
                    series.completion = self.refill.add(series, partial(self._hand_on, series))
        return series

    def receive(self, series: SeriesT, message: bytes) -> None:
        """Take a message."""
        with self._lock:
            if self._is_closed:
                return
            if not series.accepts(message):
                self.num_foreign += 1
                return
            now_s = self._hear(series.source)
            if series.key == "status":
                series.source.status = message
            completion = series.completion
            if completion is not None:
                utime, _, sequence, session = FIELDS.unpack_from(message, FINGERPRINT_BYTES)
                if sequence >= 0:
                    if not completion.has_begun:
                        self._begin_late(series, completion, sequence, utime, now_s)
                    completion.receive(message, sequence, utime, session, now_s, has_room=not self.is_full)
                    if completion.due_s < math.inf and self.refill is not None:
                        self.refill.check(series)
                    return
            self._hand_on(series, message)

    def _begin_late(
        self, series: SeriesT, completion: Completion, sequence: int, utime: int, now_s: float
    ) -> None:
        """Request what a key had since its source is heard, if its first message comes later than others."""
        first_utime = series.source.first_utime
        if sequence and first_utime is not None and utime - first_utime > _LATE_KEY_US:
            completion.begin_since(first_utime, now_s)

    def _hand_on(self, series: SeriesT, message: bytes) -> None:
        if not self._is_closed:
            series.count(message)
            self._take(series, message)

    def complete(self, ask: Ask, find: FindSeries, completeness: Completeness) -> None:
        """Complete all series from now on, with what ``ask`` returns; see Refill."""
        self.refill = Refill(self, self._lock, ask, find, completeness, self.monotonic)

    def refill_problems(self) -> set[tuple[str, str]]:
        """Return why gaps are not filled now, or the past did not come, with the names of the sources."""
        completed = [(each.source.name, each.completion) for each in self.all_series if each.completion]
        found = {(name, each.problem) for name, each in completed if each.problem}
        return found | {(name, each.past_problem) for name, each in completed if each.past_problem}

    def ignore(self, *, beyond_limit: bool) -> None:
        """Count a message that is left out."""
        with self._lock:
            self.num_foreign += not beyond_limit
            self.num_beyond += beyond_limit

    def failed(self, defect: Exception) -> None:
        """Note a defect in this program: a message is left out, but the others are not."""
        with self._lock:
            self.defect = self.defect or defect
            self.num_defects += 1

    # Parameters and status.

    def receive_parameters(self, series: SeriesT, message: bytes, *, is_made: bool) -> None:
        """Take a ``parameters_t``, published or ``is_made`` here, unless it repeats the newest one."""
        with self._lock:
            source = series.source
            source.has_answer = True
            self._hear(source)
            former = source.parameters
            if self._is_closed or (former is not None and former[_VERSION] == message[_VERSION]):
                return
            source.parameters = message
            self._take_parameters(series, message, is_first=former is None, is_made=is_made)

    def parameters_message(
        self, source: SourceT, xml: bytes, session: int | None, version: int, age_s: float = 0.0
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

    def answered(self, source: SourceT, parameters: bytes | None) -> None:
        """Take the answer to the query for the parameters; None if there are none."""
        with self._lock:
            source.has_answer = True
            if parameters is not None and source.parameters is None:
                self._take_answer(source, parameters)

    def answered_status(self, source: SourceT, message: bytes) -> None:
        """Take the answer to a query for the status."""
        with self._lock:
            source.status = source.status or message

    def answered_takes(self, source: SourceT, content: bytes) -> None:
        """Take the answer to a query for the takes, as JSON."""
        try:
            answer = json.loads(content)
            running = [
                take["name"] for take in (answer["running"] or {}, *answer["takes"]) if take.get("is_running")
            ]
        except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
            return  # of another program
        source.running_take = str(running[0]) if running else ""

    def _hear(self, source: ReceivedSource) -> float:
        now_s = self.monotonic()
        if (
            source.heard_s is not None
            and now_s - source.heard_s > SILENT_S
            and self.refill is not None
            and not self._is_closed
        ):
            self.refill.look_after_silence(source)
        source.heard_s = now_s
        if self.first_heard_s is None:
            self.first_heard_s = now_s
        return now_s

    # For subclasses.

    @property
    def has_room(self) -> bool:
        """Whether more messages can be taken now. Nothing is requested otherwise."""
        return True

    @property
    def is_full(self) -> bool:
        """Whether what arrives of completed series is let go now, and requested when there is room."""
        return False

    def _completes(self, series: SeriesT) -> bool:
        """Whether to fill the gaps of a series."""
        return series.key != "parameters"

    @abstractmethod
    def _new_source(self, name: str, channels: str) -> SourceT: ...

    @abstractmethod
    def _new_series(self, source: SourceT, key: str, channel: str) -> SeriesT: ...

    @abstractmethod
    def _take(self, series: SeriesT, message: bytes) -> None:
        """Take a message that was counted."""

    def _take_parameters(self, series: SeriesT, message: bytes, *, is_first: bool, is_made: bool) -> None:
        """Take parameters that differ from the newest ones, and are the source's newest ones now."""

    def _take_answer(self, source: SourceT, parameters: bytes) -> None:
        """Take the answer to the query for the parameters, before any were published."""
        source.parameters = parameters


class Messages(Reception[ReceivedSource, ReceivedSeries]):
    """Passes each message on, once at a time, to a function that takes the source, the key and the message.

    The key is that on Zenoh, below the source, such as "3d", "6d/Tool 1" or "parameters".
    """

    def __init__(self, receive: Callable[[str, str, bytes], object]) -> None:
        super().__init__()
        self._receive = receive

    def _new_source(self, name: str, channels: str) -> ReceivedSource:
        return ReceivedSource(name, channels, self.monotonic)

    def _new_series(self, source: ReceivedSource, key: str, channel: str) -> ReceivedSeries:
        return ReceivedSeries(source, key, channel)

    def _take(self, series: ReceivedSeries, message: bytes) -> None:
        self._receive(series.source.name, series.key, message)

    def _take_parameters(
        self,
        series: ReceivedSeries,
        message: bytes,
        *,
        is_first: bool,  # noqa: ARG002 - it overrides
        is_made: bool,  # noqa: ARG002 - it overrides
    ) -> None:
        self._receive(series.source.name, series.key, message)
