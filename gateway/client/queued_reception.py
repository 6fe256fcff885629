"""Messages of components that wait to be decoded, and what describes them: for ``live`` and for displays."""

import contextlib
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple, TypeVar

from typing_extensions import override

from gateway.client.reception import Reception
from gateway.client.sources import ReceivedSeries, ReceivedSource
from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.messages.host_time import now_steady_us, now_utime
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.takes.files.parameters_history import ParametersEntry, ParametersHistory

MAX_WAITING: Final = 40_000
"""How many messages of all sources may wait: 18 s of 200 frames of markers and 2000 of channels a second."""

MAX_WAITING_BYTES: Final = 64 * 1024 * 1024

_FULL: Final = 0.75
"""From which share of these limits completed series let go what arrives, and request it later."""

_MAX_ENTRIES: Final = 16
"""How many parameters of a source are kept: frames that wait belong to the newest ones."""


class QueuedSeries(ReceivedSeries):
    """The messages of one key of a source, of which the newest ones wait to be decoded."""

    def __init__(self, source: ReceivedSource, key: str, channel: str) -> None:
        super().__init__(source, key, channel)
        self.newest: QueuedMessage | None = None
        """The newest message."""
        self.num_dropped = 0
        """How many messages were left out, because too many waited."""
        self.pending_gap = 0
        """How many messages are missing before the next one that is taken, because they were left out."""
        self.num_malformed = 0
        """How many messages could not be decoded."""
        self.malformed_gap = 0
        """How many of them came after the last one that could be."""
        self._num_lost = 0

    @property
    def is_past(self) -> bool:
        """Whether what is taken now ``is_past``; see QueuedMessage."""
        return self.completion is not None and self.completion.is_past

    def new_losses(self) -> int:
        """Return how many messages are missing before the one that was counted last."""
        before, self._num_lost = self._num_lost, self.check.num_lost
        return max(0, self._num_lost - before)  # fewer, if a late message has filled a gap


class QueuedMessage(NamedTuple):
    """A message of a component.

    ``arrived_utime`` is when it arrived, on this host's clock, and ``steady_us`` the same on the clock that
    nobody sets; ``gap`` is how many are missing before it. One that ``is_past`` was published before the
    subscriber began, or has waited for such messages.
    """

    series: QueuedSeries
    message: bytes
    arrived_utime: int
    gap: int
    is_past: bool = False
    steady_us: int = 0


class DescribedSource(ReceivedSource):
    """A source, and the server's parameters that describe its frames.

    ``update_parameters`` and what it changes belong to one thread.
    """

    def __init__(self, name: str, channels: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__(name, channels, monotonic)
        self.entries: list[ParametersEntry] = []
        """The newest parameters, in the order of their times."""
        self.num_unreadable = 0
        """How many parameters could not be read."""
        self.unread: deque[bytes] = deque(maxlen=_MAX_ENTRIES)
        """What has arrived since the last ``update_parameters``."""
        self._history = ParametersHistory()
        self._arrived: deque[ParametersEntry] = deque(maxlen=_MAX_ENTRIES)  # times can be set back
        self._entries_by_version: dict[int, list[ParametersEntry]] = {}

    @property
    def newest_entry(self) -> ParametersEntry | None:
        """The newest parameters; None before the first."""
        return self._history.newest

    def update_parameters(self) -> None:
        """Decode the parameters that have arrived."""
        while self.unread:
            try:
                entry = self._history.add(decode(self.unread.popleft()))
            except ProtocolError:
                self.num_unreadable += 1
                continue
            if entry is None:
                continue
            self.num_unreadable += not self._history.is_readable
            self._arrived.append(entry)
            self.entries = sorted(self._arrived, key=lambda each: each.utime)
            self._entries_by_version = {}
            for each in self.entries:
                self._entries_by_version.setdefault(each.version, []).append(each)

    def has_version(self, version: int) -> bool:
        """Return whether there are parameters of this version."""
        return version in self._entries_by_version

    def is_unique(self, version: int) -> bool:
        """Return whether at most one has this version: they start again with the gateway."""
        return len(self._entries_by_version.get(version, ())) <= 1

    def entry_of(self, version: int, utime: int) -> ParametersEntry | None:
        """Return the parameters that describe a frame, by the rule of ``Series``; None if there are none."""
        entries = self._entries_by_version.get(version)
        if entries is None:
            return None
        return next((each for each in reversed(entries) if each.utime <= utime), entries[0])


SourceT = TypeVar("SourceT", bound=DescribedSource)


class QueuedReception(Reception[SourceT, QueuedSeries]):
    """Keeps messages of components, in the order of their arrival, until somebody takes them.

    If that takes too long, the oldest are left out and counted.
    """

    def __init__(self, *, is_queueing: bool = True, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__(monotonic)
        self.num_dropped = 0
        """How many messages were left out, because too many waited."""
        self.is_queueing = is_queueing
        """Whether messages are kept for ``take_waiting``; otherwise, only the newest of each series."""
        self.num_changes = 0
        """How often a message or parameters have arrived."""
        self._waiting: deque[QueuedMessage] = deque()
        self._waiting_bytes = 0
        self._num_asleep = 0  # threads in ``wait``
        self._changed = threading.Condition(self._lock)
        self._on_change: list[Callable[[], object]] = []

    # In the thread that reads.

    def take_waiting(self, max_messages: int = MAX_WAITING) -> list[QueuedMessage]:
        """Return the messages that wait, the oldest first, and remove them."""
        taken: list[QueuedMessage] = []
        with self._lock:
            while self._waiting and len(taken) < max_messages:
                arrival = self._waiting.popleft()
                series = arrival.series
                self._waiting_bytes -= len(arrival.message)
                if series.pending_gap:
                    arrival = arrival._replace(gap=arrival.gap + series.pending_gap)
                    series.pending_gap = 0
                taken.append(arrival)
        return taken

    def clear_waiting(self) -> None:
        """Forget the messages that wait."""
        with self._lock:
            self._waiting.clear()
            self._waiting_bytes = 0

    def wait(self, num_seen: int, timeout_s: float | None) -> None:
        """Wait until ``num_changes`` is no longer ``num_seen``, or it is closed."""
        with self._lock:
            if self.num_changes == num_seen and not self._is_closed:
                self._num_asleep += 1
                self._changed.wait(timeout_s)
                self._num_asleep -= 1

    def call_at_change(self, num_seen: int, function: Callable[[], object]) -> None:
        """Call a function, once, when ``wait`` would return."""
        with self._lock:
            if self.num_changes == num_seen and not self._is_closed:
                self._on_change.append(function)
                return
        function()

    @property
    def has_waiting(self) -> bool:
        """Whether ``take_waiting`` would return anything."""
        return bool(self._waiting)

    @property
    def has_room(self) -> bool:
        """Whether more messages can be taken now without leaving out older ones."""
        return len(self._waiting) < MAX_WAITING // 2 and self._waiting_bytes < MAX_WAITING_BYTES // 2

    @property
    @override
    def is_full(self) -> bool:
        """There is still room for what was requested."""
        return len(self._waiting) >= _FULL * MAX_WAITING or self._waiting_bytes >= _FULL * MAX_WAITING_BYTES

    def close(self) -> None:
        """Take nothing more, and wake all that wait."""
        with self._lock:
            self._is_closed = True
            self._notify()

    # In the threads that receive.

    def _take(self, series: QueuedSeries, message: bytes) -> None:
        if series.key not in COMPONENTS_BY_KEY:
            return
        gap = series.new_losses()
        series.newest = arrival = QueuedMessage(
            series, message, now_utime(), gap, series.is_past, now_steady_us()
        )
        if not self.is_queueing:
            return
        self._waiting.append(arrival)
        self._waiting_bytes += len(message)
        while len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
            oldest = self._waiting.popleft()
            self._waiting_bytes -= len(oldest.message)
            self.num_dropped += 1
            oldest.series.num_dropped += 1
            oldest.series.pending_gap += 1 + oldest.gap
        self._notify()

    def _take_parameters(
        self,
        series: QueuedSeries,
        message: bytes,
        *,
        is_first: bool,  # noqa: ARG002 - overrides
        is_made: bool,  # noqa: ARG002 - overrides
    ) -> None:
        source: Any = series.source
        source.unread.append(message)
        self._notify()

    def _take_answer(self, source: SourceT, parameters: bytes) -> None:
        super()._take_answer(source, parameters)
        source.unread.append(parameters)
        self._notify()

    def _notify(self) -> None:
        self.num_changes += 1
        if self._num_asleep:
            self._changed.notify_all()
        if self._on_change:
            waiting, self._on_change = self._on_change, []
            for function in waiting:
                with contextlib.suppress(RuntimeError):  # an event loop that is closed
                    function()

    # For subclasses.

    @abstractmethod
    def _new_source(self, name: str, channels: str) -> SourceT: ...

    def _new_series(self, source: SourceT, key: str, channel: str) -> QueuedSeries:
        return QueuedSeries(source, key, channel)
