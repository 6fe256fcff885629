"""Reading a take: which source and which kind of message each event of its files belongs to."""

import contextlib
import itertools
import math
import stat
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ProtocolError, TakeError
from gateway.messages.decode import decode, message_type
from gateway.messages.encode import MESSAGE_TYPES, VERSION_OFFSET
from gateway.messages.take_names import by_number
from gateway.messages.topics import unique_name
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.description import has_end
from gateway.takes.files.event_log import Event, EventColumns, EventLogReader

NAMED_WITHIN_EVENTS: Final = 50_000
"""Each source is named within this many events: by its description, or by its status once a second."""

_POSE: Final = "_6D_"
_MAX_NAME_LENGTH: Final = 1000


class SourceNames:
    """The names of the sources by the beginning of their channels, such as MOCAP_LAB.

    A source is named by its description or its status. Without both, its name is made from the channels.
    Each source has another name, also if two gateways with different prefixes have sources of one name.
    """

    def __init__(self, events: Iterable[Event]) -> None:
        self._names: dict[str, str] = {}  # by the beginning of the channels
        self._taken: set[str] = set()  # the same names: with thousands of channels, a look-up must be quick
        for event in events:
            try:
                kind = message_type(event.message)
                if kind is rtc3d.take_t or kind is rtc3d.status_t:
                    self._add(event.channel.rpartition("_")[0], decode(event.message).source)
            except ProtocolError:
                continue

    @property
    def names(self) -> list[str]:
        """The names of the sources so far."""
        return list(self._names.values())

    def source(self, channels: str) -> str:
        """Return the name of the source whose channels begin with this, such as MOCAP_LAB."""
        if channels not in self._names:
            self._add(channels, channels.partition("_")[2].lower() or channels.lower() or "take")
        return self._names[channels]

    def source_and_tool(self, channel: str) -> tuple[str, str] | None:
        """Return the source and the key of a tool's pose; None if it is not the channel of one.

        Labels and names of sources may have the separator in them, too.
        """
        channels = channel.partition(_POSE)[0]
        end = len(channels)
        while end >= 0:
            if channel[:end] in self._names:
                channels = channel[:end]
            end = channel.find(_POSE, end + 1)
        label = channel[len(channels) + len(_POSE) :]
        return (self.source(channels), f"6d/{label}") if label else None

    def _add(self, channels: str, name: str) -> None:
        if channels in self._names:
            return
        if not name or name in self._taken:
            name = channels.lower()
        self._names[channels] = unique_name(name, self._taken, _MAX_NAME_LENGTH)
        self._taken.add(self._names[channels])


SUFFIX: Final = ".lcmlog"
"""The extension of an event log."""

_BATCH_BYTES: Final = 4 * 1024 * 1024
"""A batch ends after about this many bytes of the files."""

_MAX_LATE_US: Final = 10_000_000
"""This long after the end of a range, no more messages belong to it."""

_MAX_ROUTES: Final = 10_000

_MAX_SHOWN: Final = 5
"""How many channels an error lists."""

_KEYS: Final[dict[type[Any], str]] = {
    **{message_type: component.key for component, message_type in MESSAGE_TYPES.items()},
    rtc3d.status_t: "status",
    rtc3d.clock_t: "clock",
    rtc3d.parameters_t: "parameters",
    rtc3d.take_t: "take",
    rtc3d.take_details_t: "details",
    rtc3d.take_end_t: "end",
}


_DESCRIPTION: Final[bytes] = rtc3d.take_t._get_packed_fingerprint()  # noqa: SLF001 - see encode.py

DESCRIPTIONS: Final = frozenset({"take", "details", "end"})
"""The keys of messages that are in files only, without numbers."""


class TakeMessage(NamedTuple):
    """One message of a take.

    ``key`` is the part of its Zenoh key below the source: "3d", "6d", "analog", "force", "event", "status",
    "clock", "parameters", "6d/LABEL" (a pose), "take" for a ``take_t``, "details" for a
    ``take_details_t``, or "end" for a ``take_end_t``. ``utime`` is the event's time.
    """

    utime: int
    source: str
    key: str
    message: bytes


_END_BYTES: Final = 4096
"""How much of the end of a file is searched for its ``take_end_t``."""


class Place(NamedTuple):
    """Where an event begins: the number of the file in ``TakeReader.logs``, and the offset in it in bytes."""

    log: int
    offset: int


FIRST_PLACE: Final = Place(0, 0)


@dataclass(slots=True)
class MessageBatch:
    """Messages of one source and key in their order, with the times of their events in µs since 1970.

    ``recording`` counts the takes that somebody has put into one file, one after the other (``cat``).
    """

    source: str
    key: str
    recording: int = 0
    utimes: list[int] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)

    def messages_between(self, first_utime: float, end_utime: float) -> list[bytes]:
        """Return the messages from a time on and before another one."""
        if first_utime <= min(self.utimes) <= max(self.utimes) < end_utime:
            return self.messages
        events = zip(self.utimes, self.messages, strict=True)
        return [message for utime, message in events if first_utime <= utime < end_utime]


class TakeReader:
    """Reads a take: an event log, or a folder of them (a saved take) as one.

    Creating it reads the beginning, and raises TakeError if there is no take.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.logs = [EventLogReader(log) for log in log_paths(path)]
        """The files. After a complete pass, they know their damage."""
        self.unknown: Counter[str] = Counter()
        """How many messages have a type that this version does not know, by channel, in the newest pass."""
        self.empty_files: dict[Path, str] = {}
        """Files of a folder without any event, and why, in the newest pass."""
        self._log = 0
        self._offset = 0
        self._names = SourceNames(itertools.islice(self.events(), NAMED_WITHIN_EVENTS))
        self._routes: dict[tuple[str, bytes], tuple[str, str] | None] = {}  # by channel and fingerprint
        self.start_utime: int = next(self.events()).utime
        """The time of the first event."""

    def first_utime(self) -> int:
        """Return the time of the first moment; with several takes in one file, that of the earliest of them.

        To find these takes, the files are searched for descriptions, which takes as long as the disk does.
        """
        utimes = [self.start_utime]
        for log in self.logs:
            described: set[bytes] = set()
            for utime, channel in log.utimes_of(_DESCRIPTION):
                if channel in described:
                    utimes.append(utime)
                described.add(channel)
        return min(utimes)

    def cut_off_sources(self) -> list[str]:
        """Return the sources of files that were not ended in order, by their first and their last events."""
        names: dict[str, None] = {}
        for log in self.logs:
            with contextlib.suppress(OSError, ProtocolError, StopIteration, TakeError):
                first = next(EventLogReader(log.path).events())
                if _type_of(first) is rtc3d.take_t and not _has_ended(log.path):
                    take = decode(first.message)
                    names |= {take.source: None} if has_end(take) else {}
        return [*names]

    @property
    def num_bytes(self) -> int:
        """The size of all files; 0 for a file that is gone."""
        num_bytes = 0
        for log in self.logs:
            with contextlib.suppress(OSError):
                num_bytes += log.path.stat().st_size
        return num_bytes

    @property
    def read_bytes(self) -> int:
        """How far the newest pass has come."""
        return sum(log.offset for log in self.logs)

    @property
    def num_damaged(self) -> int:
        """How many places of the files could not be read; a file without any event is one."""
        return sum(log.num_damaged for log in self.logs) + len(self.empty_files)

    @property
    def damaged_bytes(self) -> int:
        """How many bytes belong to no readable event."""
        return sum(log.damaged_bytes for log in self.logs)

    @property
    def source_names(self) -> list[str]:
        """The names of the sources in what was read so far."""
        return self._names.names

    @property
    def place(self) -> Place:
        """Where the newest message of ``messages`` begins."""
        return Place(self._log, self._offset)

    def events(self, start: Place = FIRST_PLACE) -> Iterator[Event]:
        """Yield the events of all files, from a place on. Raises TakeError."""
        return filter(None, self._collect({}, start))

    def _collect(
        self, columns: Mapping[bytes, EventColumns], start: Place = FIRST_PLACE
    ) -> Iterator[Event | None]:
        """Yield what ``EventLogReader.collect`` does for each file."""
        self.empty_files = {}
        for log in self.logs:
            log.offset = 0
        for number, log in enumerate(self.logs[start.log :], start=start.log):
            self._log = number
            try:
                yield from log.collect(columns, start.offset if number == start.log else 0)
            except TakeError as error:
                # After a loss of power, one file of a folder may be empty.
                self.empty_files[log.path] = str(error)
                if len(self.empty_files) == len(self.logs):
                    raise

    def messages(self, start: Place = FIRST_PLACE) -> Iterator[TakeMessage]:
        """Yield the messages of a gateway, in their order, from a place on.

        Raises TakeError, also if there are none.
        """
        self.unknown.clear()
        routes, new_message = self._routes, tuple.__new__
        for event in self.events(start):
            _, utime, channel, message, offset = event
            self._offset = offset
            identity = (channel, message[:8])
            route = routes[identity] if identity in routes else self._route(identity)
            if route is None:
                self.unknown[channel] += 1
            else:
                yield new_message(TakeMessage, (utime, *route, message))
        self._check_is_take()

    def batches(self, end_utime: float = math.inf) -> Iterator[list[MessageBatch]]:
        """Yield the messages of a gateway in batches of some MB, each with one entry per source and key.

        This is the fast way to read everything. A batch ends before parameters that differ from those
        before, and before another take in the same file. What comes more than 10 s after ``end_utime`` is
        not read: nothing before it arrives so late, unless an earlier take follows in the same file. Raises
        TakeError, also if there are no such messages.
        """
        if math.isfinite(end_utime) and self.first_utime() < self.start_utime:
            end_utime = math.inf
        for batches in self._batches():
            # `all` stops at the first batch with an earlier message, so that reading a whole take stays fast.
            if batches and all(min(batch.utimes) > end_utime + _MAX_LATE_US for batch in batches):
                return
            yield batches

    def _batches(self) -> Iterator[list[MessageBatch]]:
        """Yield all that ``batches`` does."""
        self.unknown.clear()
        batches: dict[tuple[str, bytes], MessageBatch] = {}  # by channel and fingerprint
        columns: dict[bytes, EventColumns] = {}  # of the same, except parameters
        newest: dict[str, bytes] = {}  # parameters, by source
        described: set[tuple[int, str]] = set()  # files and sources
        recording = 0
        first_byte = 0
        for event in self._collect(columns):
            if event is None:
                if self.read_bytes - first_byte >= _BATCH_BYTES:
                    yield [*batches.values()]
                    batches.clear()
                    columns.clear()
                    first_byte = self.read_bytes
                continue
            _, utime, channel, message, _ = event
            identity = (channel, message[:8])
            batch = batches.get(identity)
            if batch is None:
                route = self._route(identity)
                if route is None:
                    self.unknown[channel] += 1
                    continue
                batch = MessageBatch(*route, recording)
            if batch.key == "take":
                if (self._log, batch.source) in described:  # a file has one description of each source
                    recording += 1
                    described.clear()
                    yield [*batches.values()]
                    batches.clear()
                    columns.clear()
                    batch = MessageBatch(batch.source, batch.key, recording)
                described.add((self._log, batch.source))
            elif batch.key != "parameters":
                columns[channel.encode() + message[:8]] = EventColumns(batch.utimes, batch.messages)
            elif newest.get(batch.source) != message[VERSION_OFFSET:]:
                newest[batch.source] = message[VERSION_OFFSET:]
                yield [*batches.values()]
                batches.clear()
                columns.clear()
                batch = MessageBatch(batch.source, batch.key, recording)
            batches[identity] = batch
            batch.utimes.append(utime)
            batch.messages.append(message)
        yield [*batches.values()]
        self._check_is_take()

    def _check_is_take(self) -> None:
        """Raise TakeError if no message of a gateway was found."""
        if self._names.names:
            return
        channels = [safe_text(channel) for channel in sorted(self.unknown)]
        shown = ", ".join(channels[:_MAX_SHOWN]) + (", …" if len(channels) > _MAX_SHOWN else "")
        version = (
            "; they may be of another version of the gateway"
            if any(map(is_gateways_channel, self.unknown))
            else ""
        )
        raise TakeError(
            f"{safe_text(str(self.path))} has no message of this gateway, but "
            f"{sum(self.unknown.values())} messages of other types, on channel {shown}{version}"
        )

    def _route(self, identity: tuple[str, bytes]) -> tuple[str, str] | None:
        """Return the source and the key of a channel; None if the type of its messages is unknown."""
        channel, fingerprint = identity
        if identity not in self._routes:
            if len(self._routes) >= _MAX_ROUTES:
                self._routes.clear()  # a log of damage, or of a program with millions of channels
            route: tuple[str, str] | None = None
            with contextlib.suppress(ProtocolError):
                kind = message_type(fingerprint)
                if kind is rtc3d.tool_pose_t:
                    route = self._names.source_and_tool(channel)
                elif kind in _KEYS:
                    route = self._names.source(channel.rpartition("_")[0]), _KEYS[kind]
            self._routes[identity] = route
        return self._routes[identity]


def _has_ended(path: Path) -> bool:
    """Return whether the last event of a file is a ``take_end_t``. Raises OSError."""
    first_byte = max(0, path.stat().st_size - _END_BYTES)
    try:
        last = deque(EventLogReader(path).events(first_byte), maxlen=1)
    except TakeError:  # there is no event in these bytes
        return False
    return bool(last) and _type_of(last[0]) is rtc3d.take_end_t


def _type_of(event: Event) -> type[Any] | None:
    """Return the type of an event's message; None if it is none of a gateway's."""
    try:
        return message_type(event.message)
    except ProtocolError:
        return None


def log_paths(path: Path) -> list[Path]:
    """Return the event logs of a take: the file itself, or those in a folder, by name. Raises TakeError.

    If a folder has no .lcmlog files, it may have those of lcm-logger: NAME.0, NAME.1, … or NAME.00, …, which
    are sorted by their first events, because lcm-logger may number them backwards.
    """
    try:
        if not stat.S_ISDIR(path.stat().st_mode):
            return [path]
        entries = sorted(path.iterdir(), key=by_number)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TakeError(f"{safe_text(str(path))} cannot be read: {reason}") from error
    logs = [entry for entry in entries if entry.suffix == SUFFIX]
    if not logs:
        numbered = [entry for entry in entries if entry.suffix[1:].isdecimal()]
        logs = sorted(numbered, key=_first_utime)
    if not logs:
        raise TakeError(
            f"{safe_text(str(path))} has no recordings ({SUFFIX}); choose a recording or the folder of one"
        )
    return logs


def _first_utime(log: Path) -> int:
    try:
        return next(EventLogReader(log).events()).utime
    except TakeError:
        return 0


def is_gateways_channel(channel: str) -> bool:
    """Return whether a channel is named as one of a gateway."""
    return channel.rpartition("_")[2].lower() in _KEYS.values()
