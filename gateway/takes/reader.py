"""Reading a take: which source and which kind of message each event of its files belongs to."""

import itertools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ProtocolError, TakeError
from gateway.messages.decode import decode, message_type
from gateway.messages.encode import MESSAGE_TYPES
from gateway.takes.event_log import Event, EventLogReader

SUFFIX: Final = ".lcmlog"
"""The extension of an event log."""

_NAMED_WITHIN_EVENTS: Final = 20_000
"""Within so many events, each source has been named: by its description, or by its status once a second."""

_KEYS: Final[dict[type[Any], str]] = {
    **{message_type: component.key for component, message_type in MESSAGE_TYPES.items()},
    rtc3d.status_t: "status",
    rtc3d.clock_t: "clock",
    rtc3d.parameters_t: "parameters",
    rtc3d.take_t: "take",
}
_POSE: Final = "_6D_"


class TakeMessage(NamedTuple):
    """One message of a take.

    ``key`` is the part of its Zenoh key below the source: "3d", "6d", "analog", "force", "event", "status",
    "clock", "parameters", "6d/LABEL" (a pose), or "take" for a ``take_t``. ``utime`` is the event's time.
    """

    utime: int
    source: str
    key: str
    message: bytes


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
        self._sources = self._named_sources()
        self._routes: dict[tuple[str, bytes], tuple[str, str] | None] = {}  # by channel and fingerprint
        self.start_utime: int = next(self.events()).utime
        """The time of the first event."""

    def events(self) -> Iterator[Event]:
        """Yield all events of all files. Raises TakeError."""
        return itertools.chain.from_iterable(log.events() for log in self.logs)

    def messages(self) -> Iterator[TakeMessage]:
        """Yield the messages of a gateway, in their order. Raises TakeError."""
        self.unknown.clear()
        routes = self._routes
        for event in self.events():
            identity = (event.channel, event.message[:8])
            if identity not in routes:
                routes[identity] = self._route(event)
            route = routes[identity]
            if route is None:
                self.unknown[event.channel] += 1
            else:
                yield TakeMessage(event.utime, *route, event.message)

    @property
    def source_names(self) -> list[str]:
        """The names of the sources in what was read so far."""
        return list(dict.fromkeys(route[0] for route in self._routes.values() if route is not None))

    def _named_sources(self) -> dict[str, str]:
        """Return the names of the sources by the beginning of their channels."""
        names: dict[str, str] = {}
        for event in itertools.islice(self.events(), _NAMED_WITHIN_EVENTS):
            kind = _type_of(event.message)
            if kind is rtc3d.take_t or kind is rtc3d.status_t:
                try:
                    message = decode(event.message)
                except ProtocolError:
                    continue
                channels = event.channel.rpartition("_")[0]
                names.setdefault(channels, message.source)
        return names

    def _route(self, event: Event) -> tuple[str, str] | None:
        """Return the source and the key of an event's channel; None if its type is unknown."""
        kind = _type_of(event.message)
        if kind is rtc3d.tool_pose_t:
            channels, separator, label = event.channel.rpartition(_POSE)
            return (self._source(channels), f"6d/{label}") if separator else None
        if kind is None or kind not in _KEYS:
            return None
        return self._source(event.channel.rpartition("_")[0]), _KEYS[kind]

    def _source(self, channels: str) -> str:
        """Return the name of the source with these channels; without a description, it is made from them."""
        return self._sources.get(channels) or channels.partition("_")[2].lower() or channels.lower() or "take"


def log_paths(path: Path) -> list[Path]:
    """Return the event logs of a take: the file itself, or those in a folder, by name. Raises TakeError."""
    if not path.is_dir():
        return [path]
    try:
        logs = sorted(entry for entry in path.iterdir() if entry.suffix == SUFFIX)
    except OSError as error:
        raise TakeError(f"{path} cannot be read: {error.strerror}") from error
    if not logs:
        raise TakeError(f"{path} has no recordings ({SUFFIX}); choose a recording or the folder of one")
    return logs


def _type_of(message: bytes) -> type[Any] | None:
    try:
        return message_type(message)
    except ProtocolError:
        return None
