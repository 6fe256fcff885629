"""The newest data of all sources that are received, decoded when they are shown."""

import logging
import time
from collections import deque
from typing import Any, Final, NamedTuple

from gateway.client.reception import Reception, Series, Source
from gateway.descriptions.labels import EventText, event_text
from gateway.display.live.component import LiveComponent
from gateway.errors import ParametersError, ProtocolError
from gateway.messages.decode import decode
from gateway.messages.source_report import SourceReport, source_report
from gateway.messages.texts import xml_bytes
from gateway.messages.topics import lcm_channel
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.rtc3d.parameters import Parameters
from gateway.rtc3d.parameters_xml import parse_parameters

NUM_EVENTS: Final = 20
"""How many of the newest events of a source are kept."""

_NO_STATUS_S: Final = 3.0
"""A gateway that runs sends a status every second."""

logger = logging.getLogger(__name__)


class LiveEvent(NamedTuple):
    """An event, and when it was captured: µs since the Unix epoch, on the gateway's clock."""

    capture_utime: int
    text: EventText


class LiveSource(Source):
    """What a source publishes now."""

    def __init__(self, name: str, channels: str) -> None:
        super().__init__(name, channels)
        self.components: dict[str, LiveComponent] = {}
        """The components that have come so far, by key. The threads that receive add to it."""
        self.events: deque[LiveEvent] = deque(maxlen=NUM_EVENTS)
        """The newest events, the newest one last."""
        self.newest_parameters = Parameters()
        """The server's parameters; without any section until they come."""
        self.parameters_version = 0
        self.report: SourceReport | None = None
        """What the newest status says; None before the first."""
        self.first_report: SourceReport | None = None
        """What the first status since the gateway's start says that came here."""
        self.num_unreadable = 0
        """How many parameters and statuses could not be read."""
        self._read_parameters: bytes | None = None
        self._read_status: bytes | None = None
        self._status_s = 0.0

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

    def update(self, arrived: dict[str, list[tuple[bytes, int]]]) -> None:
        """Decode what has arrived since the last call, by the key of the component."""
        if self.parameters is not self._read_parameters:
            self._read_parameters = self.parameters
            self._decode_parameters(self.parameters or b"")
        if self.status is not self._read_status:
            self._read_status = self.status
            self._decode_status(self.status or b"")
        for key, component in [*self.components.items()]:
            component.update(arrived.get(key, []), self.newest_parameters)
        events = self.components.get("event")
        if events is not None:
            self._add_events(events)

    def _decode_parameters(self, message: bytes) -> None:
        try:
            decoded = decode(message)
            xml = xml_bytes(decoded.xml)
            self.newest_parameters = parse_parameters(xml).parameters if xml else Parameters()
            self.parameters_version = decoded.parameters_version
        except (ParametersError, ProtocolError) as error:
            self.num_unreadable += 1
            logger.debug("%s: parameters: %s", self.name, error)

    def _decode_status(self, message: bytes) -> None:
        try:
            former, self.report = self.report, source_report(decode(message))
            if former is None or former.sequence > self.report.sequence:
                self.first_report = self.report
            self._status_s = time.monotonic()
        except ProtocolError as error:
            self.num_unreadable += 1
            logger.debug("%s: status: %s", self.name, error)

    def _add_events(self, events: LiveComponent) -> None:
        heads = events.batch.heads
        for num_items, items in events.batch.items.items():
            times = heads["capture_utime"][heads["num_items"] == num_items]
            for utime, row in zip(times[-NUM_EVENTS:], items[-NUM_EVENTS:], strict=True):
                for item in row[-NUM_EVENTS:]:
                    self.events.append(LiveEvent(int(utime), event_text(self.newest_parameters, item)))


class LiveData(Reception[LiveSource, Series]):
    """The newest data of all sources.

    Messages are received in the threads of Zenoh or LCM. ``update`` decodes them; it and everything that it
    changes belong to one thread. Messages that are not decoded in time are skipped, never queued.
    """

    def update(self) -> list[LiveSource]:
        """Decode what has arrived; return the sources, sorted by name. Call it at least 10 times a second."""
        with self._lock:
            sources = [*self.sources.values()]
            arrived = [
                {key: component.take_waiting() for key, component in source.components.items()}
                for source in sources
            ]
        for source, messages in zip(sources, arrived, strict=True):
            source.update(messages)
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

    def _new_source(self, name: str, channels: str) -> LiveSource:
        return LiveSource(name, channels)

    def _new_series(self, source: LiveSource, key: str, channel: str) -> Series:
        if key in COMPONENTS_BY_KEY:
            source.components[key] = LiveComponent(COMPONENTS_BY_KEY[key])
        return Series(source, key, channel)

    def _take(self, series: Series, message: bytes) -> None:
        source: Any = series.source
        component = source.components.get(series.key)
        if component is not None:
            component.receive(message)
