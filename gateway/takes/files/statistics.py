"""What is in a take, and what is missing from it: one pass over its files, with bounded memory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from gateway.errors import ProtocolError
from gateway.messages.decode import decode
from gateway.messages.descriptions.labels import describe
from gateway.messages.encode import FINGERPRINT_BYTES, PREFIX
from gateway.messages.topics import MAX_SOURCES
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.takes.files.component_rows import decode_rows
from gateway.takes.files.component_statistics import ClockSteps, ComponentStatistics, MessageStatistics
from gateway.takes.files.description import NO_DETAILS, decoded_details, has_end
from gateway.takes.files.event_log import MAX_LISTED_DAMAGE, Damage
from gateway.takes.files.parameters_history import ParametersHistory
from gateway.takes.files.parameters_statistics import ParametersStatistics
from gateway.takes.files.reader import DESCRIPTIONS, TakeReader

_MAX_TEXTS: Final = 20
_MAX_KEYS: Final = 1000
_HEAD_BYTES: Final = FINGERPRINT_BYTES + PREFIX.size


class SourceOrigin:
    """Where a source of a take comes from, as the descriptions and the statuses in the take say."""

    def __init__(self) -> None:
        self.take_name = self.recorder = self.host = ""
        """What the newest description in the take says; "" without a description."""
        self.details = NO_DETAILS
        """Who and what the take is about, according to the newest details."""
        self.servers: list[str] = []
        """HOST:PORT of the server; several if it changed."""
        self.gateway_versions: list[str] = []

    def add(self, key: str, message: Any) -> None:
        """Take the next message of this key."""
        if key == "details":
            self.details = decoded_details(message)
        if key == "take":
            self.take_name, self.recorder, self.host = message.name, message.recorder, message.host
        if key in {"take", "status"}:
            for texts, text in (
                (self.servers, message.server),
                (self.gateway_versions, message.gateway_version),
            ):
                if text and text not in texts and len(texts) < _MAX_TEXTS:
                    texts.append(text)


class GatewayLosses:
    """What the gateway lost during the take. It counts from its own start, so only the differences matter."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, str], int] = {}
        """Messages by stream or output and by cause."""
        self._newest: dict[tuple[str, str], int] | None = None  # in the newest status

    def add(self, status: Any) -> None:
        """Add what was lost since the status before."""
        places = [(stream.components, stream.drops) for stream in status.streams]
        places += [(output.name, output.drops) for output in status.outputs]
        newest = {(name, loss.cause): loss.messages for name, drops in places for loss in drops}
        before = newest if self._newest is None else self._newest
        for place, number in newest.items():
            lost = number - before.get(place, 0)
            if lost < 0:  # the gateway has started again
                lost = number
            if lost and (place in self.counts or len(self.counts) < _MAX_KEYS):
                self.counts[place] = self.counts.get(place, 0) + lost
        self._newest = newest


class SourceStatistics:
    """What a take has of one source."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.origin = SourceOrigin()
        self.components: dict[str, ComponentStatistics] = {}
        """By key: 3d, 6d, analog, force, event."""
        self.others: dict[str, MessageStatistics] = {}
        """Other messages by key: status, clock, parameters, 6d/LABEL (poses), take."""
        self.parameters = ParametersStatistics()
        self.gateway_losses = GatewayLosses()
        self.num_lost = 0
        """Messages that the recorder lost, according to the ends of the files."""
        self.clock_steps = ClockSteps()
        self._num_open = 0  # files that should have an end, and have none so far
        self._history = ParametersHistory()

    @property
    def is_cut_off(self) -> bool:
        """Whether a file was not ended in order; files of earlier versions have no end."""
        return self._num_open > 0

    @property
    def sessions(self) -> int:
        """How many connections to the server the take has."""
        return max((len(component.sessions) for component in self.components.values()), default=0)

    @property
    def server_restarts(self) -> int:
        """How often the server's time stamps or frame numbers started again."""
        return max((component.server_restarts for component in self.components.values()), default=0)

    @property
    def measurements(self) -> int:
        """How many measurements the server made, as far as its time shows: each begins with a new time."""
        return self.server_restarts + 1 if self.components else 0

    @property
    def gateway_restarts(self) -> int:
        """How often the sequence numbers started again."""
        return max((component.gaps.num_restarts for component in self.components.values()), default=0)

    def announced_hz(self, key: str) -> float | None:
        """Return the rate of a component in the newest parameters; None if they do not say it."""
        newest = self._history.newest
        if newest is None or key not in self.components:
            return None
        component = self.components[key]
        return describe(component.component, newest.parameters, component.max_items or 0).rate_hz

    def add(self, key: str, messages: list[bytes]) -> None:
        """Take the next messages with this key."""
        if key in COMPONENTS_BY_KEY:
            self._add_components(COMPONENTS_BY_KEY[key], messages)
        elif key in self.others or len(self.others) < _MAX_KEYS:
            self._add_others(key, messages)

    def finish(self) -> None:
        """Count what is left under its labels. Call it at the end."""
        for component in self.components.values():
            for version in component.versions:
                component.set_labels(version, self.parameters.by_version.get(version))

    def _add_components(self, component: ComponentType, messages: list[bytes]) -> None:
        key = component.key
        statistics = self.components.get(key)
        if statistics is None:
            statistics = self.components[key] = ComponentStatistics(component)
        statistics.num_bytes += sum(map(len, messages))
        rows = decode_rows(component, messages)
        statistics.add(rows)
        if key == next(iter(self.components)):  # one component shows the steps of the clock
            heads = rows.heads
            self.clock_steps.add(heads["utime"].astype(np.int64), heads["timestamp_us"].astype(np.int64))

    def _add_others(self, key: str, messages: list[bytes]) -> None:
        statistics = self.others.setdefault(key, MessageStatistics())
        statistics.num_bytes += sum(map(len, messages))
        whole = [message for message in messages if len(message) >= _HEAD_BYTES or key in DESCRIPTIONS]
        statistics.malformed += len(messages) - len(whole)
        for message in whole if "/" not in key and key != "clock" else ():
            try:
                self._describe(key, decode(message))
            except ProtocolError:
                statistics.malformed += 1
        if key in DESCRIPTIONS or key == "parameters":  # repeated in each file, or without numbers
            statistics.num_messages += len(whole)
        else:
            heads = np.frombuffer(b"".join([message[8:32] for message in whole]), ">i8").reshape(-1, 3)
            statistics.add_messages(heads[:, 0].astype(np.int64), heads[:, 2].astype(np.int64))

    def _describe(self, key: str, message: Any) -> None:
        self.origin.add(key, message)
        match key:
            case "parameters":
                self._set_parameters(message)
            case "take":
                self._num_open += has_end(message)
            case "end":
                self.num_lost += message.messages_lost
                self._num_open -= 1
            case "status":
                self.gateway_losses.add(message)

    def _set_parameters(self, message: Any) -> None:
        before, entry = self._history.newest, self._history.add(message)
        if entry is None:
            return
        self.others["parameters"].malformed += not self._history.is_readable
        removed = self.parameters.add(entry, None if before is None else before.parameters)
        for version, parameters in removed.items():
            for component in self.components.values():
                component.set_labels(version, parameters)


@dataclass
class TakeStatistics:
    """What a take has, and what is missing.

    Times are in µs since 1970, on the clock of the recording computer. ``seconds`` is from the earliest event
    to the latest. ``unknown`` counts messages that are none of a gateway's, by channel.
    """

    path: Path
    files: list[Path]
    num_bytes: int
    start_utime: int
    end_utime: int = 0
    num_messages: int = 0
    sources: dict[str, SourceStatistics] = field(default_factory=dict)
    unknown: dict[str, int] = field(default_factory=dict)
    num_damaged: int = 0
    damaged_bytes: int = 0
    damage: list[Damage] = field(default_factory=list)
    """The first places of damage, at most MAX_LISTED_DAMAGE."""
    empty_files: dict[Path, str] = field(default_factory=dict)
    """Files of a folder without any event, and why."""

    @property
    def seconds(self) -> float:
        """The duration in s."""
        return (self.end_utime - self.start_utime) / 1e6

    def seconds_at(self, utime: int) -> float:
        """Return a time as seconds since the beginning."""
        return (utime - self.start_utime) / 1e6

    @property
    def is_complete(self) -> bool:
        """Whether there is no damage, no gap, no malformed message, and the recorder lost nothing."""
        parts = [
            part
            for source in self.sources.values()
            for part in (*source.components.values(), *source.others.values())
        ]
        return (
            not self.num_damaged
            and not any(part.gaps.num_lost or part.malformed for part in parts)
            and not self.was_cut_short
        )

    @property
    def was_cut_short(self) -> bool:
        """Whether the recorder was cut off, or lost messages."""
        return any(source.is_cut_off or source.num_lost for source in self.sources.values())


def take_statistics(path: Path, progress: Callable[[int, int], object] | None = None) -> TakeStatistics:
    """Return the statistics of a take. ``progress`` gets the bytes that were read, and those in all.

    Raises TakeError if there is no take.
    """
    reader = TakeReader(path)
    files = [log.path for log in reader.logs]
    statistics = TakeStatistics(path, files, reader.num_bytes, reader.start_utime, reader.start_utime)
    for batches in reader.batches():
        for batch in batches:
            statistics.num_messages += len(batch.messages)
            statistics.start_utime = min(statistics.start_utime, *batch.utimes)
            statistics.end_utime = max(statistics.end_utime, *batch.utimes)
            name = batch.source
            if name in statistics.sources or len(statistics.sources) < MAX_SOURCES:
                statistics.sources.setdefault(name, SourceStatistics(name)).add(batch.key, batch.messages)
        if progress is not None:
            progress(reader.read_bytes, statistics.num_bytes)
    for source in statistics.sources.values():
        source.finish()
    statistics.unknown, statistics.empty_files = dict(reader.unknown), dict(reader.empty_files)
    statistics.num_messages += sum(reader.unknown.values())
    statistics.num_damaged, statistics.damaged_bytes = reader.num_damaged, reader.damaged_bytes
    statistics.damage = [damage for log in reader.logs for damage in log.damage][:MAX_LISTED_DAMAGE]
    return statistics
