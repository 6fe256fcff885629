"""The newest data of all sources that are received, decoded when they are shown.

``LiveData`` has a ``DisplayedSource`` for each source, and that a ``LiveComponent`` for each component.
"""

import logging
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gateway.client.queued_reception import (
    MAX_WAITING_BYTES,
    DescribedSource,
    QueuedMessage,
    QueuedReception,
    QueuedSeries,
)
from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.messages.descriptions.labels import Description, EventText, describe, event_text
from gateway.messages.host_time import now_utime
from gateway.messages.source_report import SourceReport, source_report
from gateway.messages.topics import lcm_channel
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType, is_visible
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import NATIVE_ITEM_DTYPES, Array, decode_rows
from gateway.tools.display.statistics import WINDOW_S, ArrivalRate, HeldClock, Latency, Visibility

logger = logging.getLogger(__name__)

SLOW_SHARE: Final = 0.95
"""A rate below this share of the announced one is slow."""


class LiveComponent:
    """The newest messages of one component."""

    def __init__(self, component: ComponentType) -> None:
        self.type = component
        self.batch = decode_rows(component, [])
        """What came between the last two calls of ``update``, in its order."""
        self.newest_head: Any | None = None
        """The newest message before its items, with the fields of HEAD; None before the first."""
        self.newest_items: Array = np.empty(0, NATIVE_ITEM_DTYPES[component])
        """The items of the newest message, shape (items,), in native byte order."""
        self.num_skipped = 0
        """How many messages were not decoded, because too many waited."""
        self.num_malformed = 0
        """How many messages could not be decoded."""
        self.latency = Latency()
        self.description: Description = describe(component, None, 0)
        """The labels, units and announced rate of the newest items."""
        self._visibility = Visibility()
        self._clock = HeldClock()
        self._arrivals = ArrivalRate()
        self._batch_utime: int | None = None  # when it arrived; None if it is empty, or partly of the past
        self._described: tuple[Parameters | None, int] = (None, 0)

    def hold(self) -> None:
        """Count no time since the last ``update``."""
        self._clock.hold()

    def update(
        self, arrived: Sequence[QueuedMessage], parameters: Parameters | None, gateway_utime: int = 0
    ) -> None:
        """Decode messages that have arrived, and describe their items by the source's parameters.

        ``gateway_utime`` is the time of the newest message of the source: how old those of the past are.
        """
        now_s = self._clock.go_on()
        self.batch = rows = decode_rows(self.type, [arrival.message for arrival in arrived])
        self.num_malformed += rows.malformed
        has_past = any(arrival.is_past for arrival in arrived)
        times_s = np.full(len(rows.heads), now_s)
        if has_past:
            ages_us = gateway_utime - rows.heads["utime"].astype(np.float64)
            times_s -= np.clip(ages_us / 1e6, 0, WINDOW_S)
            self._arrivals.count_past(times_s)
        else:
            self._arrivals.count(now_s, len(arrived))
        self._batch_utime = None
        if len(rows.heads):
            self._arrivals.note_newest(float(times_s[-1]))
            self._batch_utime = None if has_past else arrived[-1].arrived_utime
            head = self.newest_head = rows.heads[-1]
            self.newest_items = rows.items[int(head["num_items"])][-1]
            if not (rows.malformed or has_past):
                times = np.array([arrival.arrived_utime for arrival in arrived])
                self.latency.add(rows.heads["capture_utime"], rows.heads["utime"], times)
            if self.type in {ComponentType.MARKERS, ComponentType.TOOLS}:  # the others are never missing
                for num_items, items in rows.items.items():
                    self._visibility.add(is_visible(items), times_s[rows.heads["num_items"] == num_items])
        num_items = len(self.newest_items)
        if self._described[0] is not parameters or self._described[1] != num_items:
            self._described = (parameters, num_items)
            self.description = describe(self.type, parameters, num_items)

    def note_shown(self) -> None:
        """Take note that the newest messages are sent to the browsers now."""
        if self._batch_utime is not None:
            self.latency.shown_ms.append((now_utime() - self._batch_utime) / 1000)

    @property
    def rate_hz(self) -> float:
        """How many messages come per second, over two seconds; 0 before the second call of ``update``."""
        return self._arrivals.rate_hz

    @property
    def announced_rate_hz(self) -> float | None:
        """The rate that the server has announced; None if it has not."""
        return self.description.rate_hz

    @property
    def is_visible(self) -> Array:
        """Whether each marker or tool is visible now, shape (items,): none is if data have stopped."""
        return is_visible(self.newest_items) & (not self.is_stopped)

    @property
    def visible_shares(self) -> Array:
        """In which share of the frames of the last 10 s each marker or tool was visible, from 0 to 1.

        The shape is (items,); it is (0,) if no frame came in this time.
        """
        shares = self._visibility.shares(self._clock.now_s)
        return shares if len(shares) == len(self.newest_items) else shares[:0]

    @property
    def is_slow(self) -> bool:
        """Whether fewer messages come than the server has announced."""
        announced_hz = self.announced_rate_hz
        return announced_hz is not None and self.rate_hz < SLOW_SHARE * announced_hz

    @property
    def age_s(self) -> float | None:
        """How long ago the newest message arrived; None before the first."""
        return self._arrivals.age_s(self._clock.now_s)

    @property
    def is_stopped(self) -> bool:
        """Whether data came before and come no more. Events come at any time, so they never stop."""
        return self.type is not ComponentType.EVENT and self._arrivals.have_stopped(self._clock.now_s)


NUM_EVENTS: Final = 20
"""How many of the newest events of a source are kept."""

_NO_PARAMETERS: Final = Parameters()

_NO_STATUS_S: Final = 3.0
"""A gateway that runs sends a status every second."""


class LiveEvent(NamedTuple):
    """An event, and when it was captured: µs since the Unix epoch, on the gateway's clock."""

    capture_utime: int
    text: EventText


class DisplayedSource(DescribedSource):
    """What a source publishes now."""

    def __init__(self, name: str, channels: str) -> None:
        super().__init__(name, channels)
        self.components: dict[str, LiveComponent] = {}
        """The components that have come so far, by key. The threads that receive add to it."""
        self.events: deque[LiveEvent] = deque(maxlen=NUM_EVENTS)
        """The newest events, the newest one last."""
        self.report: SourceReport | None = None
        """What the newest status says; None before the first."""
        self.first_report: SourceReport | None = None
        """What the first status since the gateway's start says that came here."""
        self._read_status: bytes | None = None
        self._status_s = 0.0

    @property
    def newest_parameters(self) -> Parameters:
        """The server's parameters; without any section until they come."""
        return _NO_PARAMETERS if self.newest_entry is None else self.newest_entry.parameters

    @property
    def parameters_version(self) -> int:
        """The version of ``newest_parameters``; 0 until they come."""
        return 0 if self.newest_entry is None else self.newest_entry.version

    @property
    def num_skipped(self) -> int:
        """How many messages were not decoded, because too many waited."""
        return sum(component.num_skipped for component in [*self.components.values()])

    @property
    def status_age_s(self) -> float | None:
        """How long ago the newest status came; None before the first."""
        return None if self.report is None else time.monotonic() - self._status_s

    @property
    def is_silent(self) -> bool:
        """Whether its gateway cannot be heard: it sends no status."""
        age_s = self.status_age_s
        return time.monotonic() - self.found_s > _NO_STATUS_S if age_s is None else age_s > _NO_STATUS_S

    @property
    def age_s(self) -> float | None:
        """How long ago the newest data came; None before the first."""
        ages = [each.age_s for each in [*self.components.values()] if each.age_s is not None]
        return min(ages, default=None)

    @property
    def is_stopped(self) -> bool:
        """Whether some component has come before and comes no more."""
        return any(component.is_stopped for component in [*self.components.values()])

    def update(self, arrived: dict[str, list[QueuedMessage]]) -> None:
        """Decode what has arrived since the last call, by the key of the component."""
        self.update_parameters()
        if self.status is not self._read_status:
            self._read_status = self.status
            self._decode_status(self.status or b"")
        for key, component in [*self.components.items()]:
            component.update(arrived.get(key, []), self.newest_parameters, self.last_utime or 0)
        events = self.components.get("event")
        if events is None:
            return
        heads = events.batch.heads
        for num_items, items in events.batch.items.items():
            times = heads["capture_utime"][heads["num_items"] == num_items]
            for utime, row in zip(times[-NUM_EVENTS:], items[-NUM_EVENTS:], strict=True):
                for item in row[-NUM_EVENTS:]:
                    self.events.append(LiveEvent(int(utime), event_text(self.newest_parameters, item)))

    def _decode_status(self, message: bytes) -> None:
        try:
            former, self.report = self.report, source_report(decode(message))
            if former is None or former.sequence > self.report.sequence:
                self.first_report = self.report
            self._status_s = time.monotonic()
        except ProtocolError as error:
            self.num_unreadable += 1
            logger.debug("%s: status: %s", self.name, error)


class LiveData(QueuedReception[DisplayedSource]):
    """The newest data of all sources.

    Messages are received in the threads of Zenoh or LCM. ``update`` decodes them; it and everything that it
    changes belong to one thread. Messages that are not decoded in time are skipped, never queued.
    Only those of the past wait until all are there: nobody wants to see the last seconds in fast motion.
    """

    def __init__(self, *, takes_poses: bool = True) -> None:
        super().__init__()
        self.takes_poses = takes_poses
        self._past: dict[QueuedSeries, list[QueuedMessage]] = {}

    def update(self) -> list[DisplayedSource]:
        """Decode what has arrived; return the sources, sorted by name. Call it at least 10 times a second."""
        waiting = {series for series in self.all_series if series.is_past}
        for arrival in self.take_waiting():
            self._past.setdefault(arrival.series, []).append(arrival)
        if (
            waiting
            and sum(len(each.message) for all_ in self._past.values() for each in all_) > MAX_WAITING_BYTES
        ):
            waiting.clear()
        arrived = {series: self._past.pop(series) for series in [*self._past] if series not in waiting}
        sources = self.sources_now
        for source in sources:
            all_series = source.series
            for series in all_series:
                if series.key in source.components:
                    source.components[series.key].num_skipped = series.num_dropped
            source.update({series.key: arrived[series] for series in all_series if series in arrived})
        return sorted(sources, key=lambda source: source.name)

    def publish(self, source: str, key: str, message: bytes) -> None:
        """Take a message of a recording, as a replay publishes it."""
        found = self.source(source, lcm_channel("MOCAP", source), is_known=True)
        series = None if found is None else self.series(found, key, f"{found.channels}_{key.upper()}")
        if series is None:
            self.ignore(beyond_limit=True)
        elif key == "parameters":
            self.receive_parameters(series, message, is_made=False)
        else:
            self.receive(series, message)

    def hold(self) -> None:
        """Count no time since the last ``update``: a recording pauses. Call it before each ``update``."""
        for source in self.sources_now:
            for component in [*source.components.values()]:
                component.hold()

    def begin_again(self) -> None:
        """Forget everything, because a recording continues at another place."""
        with self._lock:
            self.sources.clear()
            self._num_series = 0
        self.clear_waiting()

    def _completes(self, series: QueuedSeries) -> bool:
        """Of what is not shown, the past is not needed."""
        is_complete = self.refill is not None and self.refill.completeness.is_complete
        return super()._completes(series) and (is_complete or series.key in COMPONENTS_BY_KEY)

    def _new_source(self, name: str, channels: str) -> DisplayedSource:
        return DisplayedSource(name, channels)

    def _new_series(self, source: DisplayedSource, key: str, channel: str) -> QueuedSeries:
        if key in COMPONENTS_BY_KEY:
            source.components[key] = LiveComponent(COMPONENTS_BY_KEY[key])
        return super()._new_series(source, key, channel)
