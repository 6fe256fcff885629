"""What the two transports of a client have in common: found sources, replies, and their interface."""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Generic, NamedTuple, TypeVar

from gateway.client.history_requests import INCOMPLETE, Completeness, HistoryAnswer, HistoryRequest
from gateway.client.reception import MAX_SERIES, Reception
from gateway.client.refill import KeptSeries
from gateway.client.sources import FINGERPRINTS, POSE, TYPES_BY_KEY, ReceivedSeries, ReceivedSource
from gateway.errors import ProtocolError, QueryError
from gateway.messages.decode import decode
from gateway.messages.source_report import SourceReport, source_report
from gateway.outputs.kind import DISCOVERY_S
from gateway.runtime.safe_text import safe_text

MAX_LISTED_SOURCES: Final = 1000
"""How many sources are listed, with their status only. Anybody on the network can send some."""

MAX_STATUS_BYTES: Final = 256 * 1024
_MAX_TOTAL_BYTES: Final = 4 * 1024 * 1024
"""What all statuses together may have: decoding takes about 1 s for this much."""

NO_ANSWER: Final = "its gateway does not answer"


class FoundSources:
    """Collects the sources that are found, up to MAX_LISTED_SOURCES, each with its newest status."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, ...], SourceReport] = {}
        self._num_bytes = 0
        self.heard: set[str] = set()
        """The names of all sources that were heard, wanted or not, up to MAX_LISTED_SOURCES."""
        self.num_left_out = 0
        """How many sources or statuses were left out, because there are too many."""
        self.absence = ""
        """Why nothing is found, or that the wanted source is not."""

    @property
    def sources(self) -> list[SourceReport]:
        """The sources by name, server and computer."""
        return sorted(
            self._sources.values(),
            key=lambda each: (each.name, each.gateway, each.problem, each.server, each.host, each.version),
        )

    @property
    def readable_names(self) -> list[str]:
        """The names of the sources whose status could be read, each once, sorted."""
        return sorted({each.name for each in self._sources.values() if each.streams or not each.problem})

    def add_status(self, message: bytes, name: str = "", gateway: str = "") -> None:
        """Add the source of a ``status_t``: see ``read_status``."""
        if self.takes(message):
            self.add(read_status(message, name, gateway))

    def takes(self, message: bytes) -> bool:
        """Return whether a message may still be read; count it as left out if not."""
        self._num_bytes += len(message)
        self.num_left_out += self._num_bytes > _MAX_TOTAL_BYTES
        return self._num_bytes <= _MAX_TOTAL_BYTES

    def hear(self, name: str) -> None:
        """Note the name of a source, wanted or not."""
        if len(self.heard) < MAX_LISTED_SOURCES:
            self.heard.add(safe_text(name))

    def add_silent(self, names: Iterable[str]) -> None:
        """Add sources whose gateways do not answer."""
        for name in names:
            self.add(SourceReport(safe_text(name), problem=NO_ANSWER))

    def add_routers(self, way_from: Callable[[str], Sequence[str] | None]) -> None:
        """Add to each source what ``way_from`` returns for its gateway: see SourceReport.routers."""
        for identity, source in self._sources.items():
            if source.gateway:
                self._sources[identity] = replace(source, routers=way_from(source.gateway))

    def add(self, source: SourceReport) -> None:
        """Add a source, or replace what an earlier status said about it."""
        where = (source.gateway,) if source.gateway else (source.server, source.host)
        identity = (source.name, *where)
        if identity in self._sources or len(self._sources) < MAX_LISTED_SOURCES:
            self._sources[identity] = source
        else:
            self.num_left_out += 1


def read_status(message: bytes, name: str, gateway: str = "") -> SourceReport:
    """Return what a status says about the source ``name``; if that is "", the status names it.

    The message may come from anybody, and from another version of the gateway.
    """
    problem = "its status is of another version of rtc3d-gateway"
    if len(message) > MAX_STATUS_BYTES:
        problem = f"its status is too long: {len(message)} bytes"
    elif message.startswith(FINGERPRINTS["status"]):
        try:
            return source_report(decode(message), name, gateway)
        except ProtocolError as error:
            problem = f"its status cannot be read: {error}"
    return SourceReport(safe_text(name), gateway, problem)


RETRY_S: Final = 0.5
"""How long to wait before repeating a query that got no reply, or came while there were too many."""

_CLOSE_S: Final = 0.5

_MAX_KEY_CHARACTERS: Final = 512
"""Gateways accept no longer keys in queries, and Zenoh panics above 64 kB."""

ReceivedT = TypeVar("ReceivedT")


class Query(NamedTuple):
    """A query about ``subject`` (parameters or takes), as one key of the gateway's sources.

    ``sections`` are parts of the parameters, such as "3d"; () means all.
    """

    key: str
    subject: str
    sections: tuple[str, ...] = ()
    options: Mapping[str, str] = {}


class QueryReply(NamedTuple):
    """A reply about ``source``, and what the gateway says about the content (``facts``).

    If gateways on Zenoh serve sources of the same name, the second one is called ``lab_2``. ``gateway`` is
    the id of the gateway's Zenoh session; "" on LCM.
    """

    source: str
    sections: tuple[str, ...]
    content: bytes
    facts: Mapping[str, Any] = {}
    gateway: str = ""

    def __repr__(self) -> str:
        """Return a summary: the content may have megabytes."""
        return f"<Reply of {self.source}: {len(self.content)} bytes>"

    @property
    def age_s(self) -> float | None:
        """The time since the gateway received parameters from the server; None if unknown."""
        return self._number("age_s")

    @property
    def version(self) -> int | None:
        """The ``parameters_version`` of the messages that parameters describe; None if unknown."""
        version = self._number("parameters_version")
        return None if version is None else int(version)

    def _number(self, name: str) -> float | None:
        try:
            value = float(self.facts[name])
        except (ValueError, TypeError, LookupError, OverflowError):
            return None
        return value if math.isfinite(value) else None


class QueryReplies(NamedTuple, Generic[ReceivedT]):
    """All replies to a query, and the problems of other sources; QueryError lists their codes."""

    received: ReceivedT
    problems: list[QueryError]


class TimeLimits:
    """Two time limits, both counted from now: for finding a gateway, and for its replies."""

    def __init__(self, timeout_s: float) -> None:
        start_s = time.monotonic()
        self._timeout_s = timeout_s
        self._end_s = start_s + timeout_s
        self._discovery_end_s = start_s + DISCOVERY_S

    @property
    def left_s(self) -> float:
        """Seconds left for replies; 0 when the time is up."""
        return max(0.0, self._end_s - time.monotonic())

    @property
    def discovery_is_over(self) -> bool:
        """Whether every running gateway should have been found by now."""
        return time.monotonic() >= self._discovery_end_s

    def no_reply(self, subject: str) -> QueryError:
        """Return the error for a gateway that is running but did not reply about ``subject``."""
        return QueryError(
            f"no reply about {subject} within {self._timeout_s:g} s although a gateway is running; "
            "try again, or with a longer --timeout",
            code="timeout",
        )


class GatewaySubscriber(ABC):
    """Hands what gateways publish to a Reception, sorted by source and key.

    An address is what a message arrives under: its key on Zenoh, or its channel on LCM.
    """

    def __init__(
        self,
        prefix: str,
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness,
    ) -> None:
        self._prefix = prefix
        self._components = components
        self._reception = reception
        if completeness != INCOMPLETE:
            reception.complete(self._ask_history, self._find_kept, completeness)
        self._series: dict[str, ReceivedSeries | None] = {}  # by address; None: left out
        self._closing = threading.Lock()
        self._is_closed = False

    # In the threads that receive.

    def _receive(self, address: str, message: bytes, sample: Any = None) -> None:
        """Take a message; ``sample`` is that of Zenoh."""
        try:
            series = self._series.get(address) or self._find_series(address, message)
            if series is not None:
                self._take(series, message, sample)
        except Exception as defect:  # noqa: BLE001 - the other messages are received
            self._reception.failed(defect)

    def _find_series(self, address: str, message: bytes) -> ReceivedSeries | None:
        """Return the series of an address without messages so far; None, counted, if it cannot be."""
        if address in self._series:
            self._reception.ignore(beyond_limit=True)
            return None
        identified = self._identify(address, message)
        if identified is None:
            return None
        source, key, channel = identified
        series: ReceivedSeries | None = (
            None if source is None else self._reception.series(source, key, channel)
        )
        if len(self._series) < 2 * MAX_SERIES:
            self._series[address] = series
        if series is None:
            self._reception.ignore(beyond_limit=True)
        return series

    @abstractmethod
    def _identify(self, address: str, message: bytes) -> tuple[ReceivedSource | None, str, str] | None:
        """Return the source (None if there are too many), the key and the channel of a series.

        Returns None for what is left out; that of others is counted.
        """

    @abstractmethod
    def _take(self, series: ReceivedSeries, message: bytes, sample: Any) -> None:
        """Hand a message to the reception."""

    # In the threads that request what is missing.

    @abstractmethod
    def _ask_history(
        self, series: ReceivedSeries, request: HistoryRequest, timeout_s: float
    ) -> HistoryAnswer:
        """Request messages of a series, and return the answer. Raises QueryError."""

    def _find_kept(self, source: ReceivedSource, last_s: float, timeout_s: float) -> list[KeptSeries]:
        """Return the wanted series of which the gateway has messages of the last seconds; see FindSeries."""
        overview = self._history_overview(source, timeout_s)
        found = []
        for key in recent_keys(overview, self._components, last_s):
            if key.startswith(POSE) and not self._reception.takes_poses:
                continue
            newest, utime = (overview["keys"][key].get(name) for name in ("newest", "newest_utime"))
            series = self._kept_series(source, key)
            if series is not None and isinstance(newest, int):
                found.append(KeptSeries(series, newest, int(utime)))
        return found

    @abstractmethod
    def _history_overview(self, source: ReceivedSource, timeout_s: float) -> Mapping[str, Any]:
        """Return what the history has of a source (docs/reference/queries.md). Raises QueryError."""

    @abstractmethod
    def _kept_series(self, source: ReceivedSource, key: str) -> ReceivedSeries | None:
        """Return the series of a key of the history, new or not; None if there are too many."""

    # In one other thread.

    def tick(self) -> None:
        """Query what is not known yet of new sources. Call it often."""
        for source in self._reception.sources_now:
            if source.is_waiting and source.begin_query():
                self._query(source)

    @abstractmethod
    def _query(self, source: ReceivedSource) -> None:
        """Query the parameters and the status of a source, if they are not known."""

    @abstractmethod
    def query_takes(self, source: ReceivedSource) -> None:
        """Query which take the gateway of a source records; see ReceivedSource.running_take."""

    def query_routers(self) -> None:  # noqa: B027 - there are none on LCM
        """Query now and then which routers are between gateways and here. Call it often."""

    @abstractmethod
    def silence(self) -> str:
        """Return that no gateway is found, or none with these sources; "" if one is. It may take 1 s."""

    def close(self) -> None:
        """Unsubscribe. It may block while a peer does not read, or another thread is closing it."""
        with self._closing:
            if not self._is_closed:
                self._is_closed = True
                if self._reception.refill is not None:
                    self._reception.refill.close()
                self._close()

    @abstractmethod
    def _close(self) -> None: ...


class Transport(ABC):
    """An open connection to Zenoh or LCM."""

    @abstractmethod
    def find(self, wanted: str | None) -> FoundSources:
        """Return the sources that are found, all or only the ``wanted`` one. Raises OutputError."""

    @abstractmethod
    def ask(self, query: Query, source: str | None, timeout_s: float) -> QueryReplies[list[QueryReply]]:
        """Ask ``source``, or every source that is found (None), until it has replied or time is up.

        Raises OutputError.
        """

    @abstractmethod
    def subscribe(
        self,
        sources: Collection[str],
        components: Collection[str] | None,
        reception: Reception[Any, Any],
        completeness: Completeness = INCOMPLETE,
    ) -> GatewaySubscriber:
        """See GatewayClient. Closing the subscriber closes this connection."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


def recent_keys(overview: Mapping[str, Any], components: Collection[str] | None, last_s: float) -> list[str]:
    """Return the keys of these components (None: all) of which a history has messages of the last seconds.

    Raises QueryError if the overview cannot be read.
    """
    try:
        newest = {str(key): int(facts["newest_utime"]) for key, facts in overview["keys"].items()}
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise QueryError("an answer about the history cannot be read", code="unreadable") from error
    begin_utime = max(newest.values(), default=0) - 1e6 * last_s  # a gateway publishes a status every second
    wanted = {*TYPES_BY_KEY, "6d"} if components is None else {*components, "status"}
    return [
        key
        for key, utime in newest.items()
        if utime >= begin_utime
        and key.partition("/")[0] in wanted
        and (key in TYPES_BY_KEY or key.startswith(POSE))
        and len(key) <= _MAX_KEY_CHARACTERS
    ]


def silence_text(subscriber: GatewaySubscriber, reception: Reception[Any, Any]) -> str:
    """Return why nothing has arrived so far. It may take 1 s."""
    names = ", ".join(source.name for source in reception.sources_now)
    found = f"a gateway serves {names or 'this source'}, but nothing arrives from it; try again"
    return subscriber.silence() or found


def close_in_time(subscriber: GatewaySubscriber) -> None:
    """Close a subscriber, but do not wait longer than 0.5 s: a peer that does not read delays it.

    The thread is no daemon: a program that ends meanwhile waits for it, instead of crashing in Zenoh.
    """
    thread = threading.Thread(target=subscriber.close, name="subscriber-close", daemon=False)
    thread.start()
    thread.join(_CLOSE_S)
