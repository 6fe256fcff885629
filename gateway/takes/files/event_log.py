"""LCM event logs: their format, and a reader that survives damage.

An event is a header (big-endian: sync word, number, time, sizes), the channel, and the message. lcm.EventLog
reads the same format, but ends at the first damaged byte.
"""

import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

from gateway.config.files import check_is_file
from gateway.errors import TakeError
from gateway.runtime.safe_text import safe_text

SYNC: Final = bytes.fromhex("eda1da01")
_HEADER: Final = struct.Struct(">4sqqii")
"""Sync word, event number, time in µs since the Unix epoch, size of the channel, size of the message."""
_HEADER_BYTES: Final = _HEADER.size

_FINGERPRINT_BYTES: Final = 8
"""What a message begins with: the type of LCM that it has."""

MAX_CHANNEL_BYTES: Final = 255
MAX_MESSAGE_BYTES: Final = 64 * 1024 * 1024
"""An event with a longer channel or message is damage. LCM's own channels have at most 63 bytes."""

MAX_LISTED_DAMAGE: Final = 100
"""How many places of damage are listed; all are counted."""

_MAX_NAMES: Final = 1000
"""How many names of channels are kept, so that each is decoded only once."""

_READ_BYTES: Final = 1024 * 1024
_PIECE_BYTES: Final = 64 * 1024
"""How much is read at a time of a file, and of a part of a file."""

_AHEAD_BYTES: Final = 32 * 1024 * 1024
"""How far the system reads ahead, so that a slow disk does not delay what is replayed."""

_MAX_FOREIGN_BYTES: Final = 64 * 1024 * 1024
"""A file without an event in its first 64 MiB is no event log."""


class Event(NamedTuple):
    """One message in an event log. ``offset`` is where the event begins in the file, in bytes."""

    number: int
    utime: int
    channel: str
    message: bytes
    offset: int


class EventColumns(NamedTuple):
    """The times and the messages of events of one channel."""

    utimes: list[int]
    messages: list[bytes]


class Damage(NamedTuple):
    """Bytes of a file that belong to no readable event."""

    file: Path
    offset: int
    num_bytes: int


class EventLogReader:
    """Reads the events of one file, in their order; bytes that are damaged are skipped and counted.

    ``events`` may be called again. ``damage`` and ``damaged_bytes`` describe the newest complete pass.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[Damage] = []
        """The first MAX_LISTED_DAMAGE places of damage."""
        self.num_damaged = 0
        """How many places of damage there are."""
        self.damaged_bytes = 0
        """How many bytes belong to no readable event."""
        self.offset = 0
        """About how far the newest pass has come."""

    def events(self, start_offset: int = 0, stop_offset: int | None = None) -> Iterator[Event]:
        """Yield the events from a place in the file on, to the end of the file or to another place.

        Raises TakeError if it is no event log. Nothing behind ``stop_offset`` is read.
        """
        return filter(None, self.collect({}, start_offset, stop_offset))

    def utimes_of(self, fingerprint: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the time and the channel of each message of a type, without reading the other events.

        This takes a small part of the time of ``events``. What cannot be read has no messages.
        """
        longest = _HEADER_BYTES + MAX_CHANNEL_BYTES
        kept = b""
        try:
            with open_file(self.path) as file:
                while data := file.read(_READ_BYTES):
                    data = kept + data
                    # A message that was wholly in the bytes before has been found.
                    message = data.find(fingerprint, max(len(kept) - len(fingerprint) + 1, 0))
                    while message >= 0:
                        start = data.rfind(SYNC, max(message - longest, 0), message)
                        if start >= 0 and start + _HEADER_BYTES <= message:
                            _, _, utime, channel_bytes, _ = _HEADER.unpack_from(data, start)
                            if start + _HEADER_BYTES + channel_bytes == message:
                                yield utime, data[start + _HEADER_BYTES : message]
                        message = data.find(fingerprint, message + 1)
                    kept = data[-(longest + len(fingerprint)) :]
        except (OSError, ValueError):
            return

    def collect(
        self, columns: Mapping[bytes, EventColumns], start_offset: int = 0, stop_offset: int | None = None
    ) -> Iterator[Event | None]:
        """Do as ``events``, but append most events of known channels to ``columns``; do not yield these.

        ``columns`` has as keys the bytes of a channel with the first 8 bytes of its messages. The caller may
        change it whenever this yields. About once in 1 MiB of the file, this yields None.
        """
        self.damage, self.num_damaged, self.damaged_bytes, self.offset = [], 0, 0, start_offset
        try:
            with open_file(self.path) as file:
                file.seek(start_offset)
                yield from self._collect(_Window(file, start_offset, stop_offset), columns)
        except (OSError, ValueError) as error:  # ValueError: of a path with NUL
            reason = getattr(error, "strerror", None) or error
            raise TakeError(f"{safe_text(str(self.path))} cannot be read: {reason}") from error

    def _collect(self, window: "_Window", columns: Mapping[bytes, EventColumns]) -> Iterator[Event | None]:
        has_events = False
        damage_start: int | None = None
        while window.has(1):
            self.offset = window.offset
            yield None
            if damage_start is None:
                start = window.offset
                yield from window.intact_events(columns)
                has_events |= window.offset > start
            event = window.event()
            if event is None:
                if damage_start is None:
                    damage_start = window.offset
                window.skip_to_sync()
                if not has_events and window.offset - damage_start > _MAX_FOREIGN_BYTES:
                    break
                continue
            if damage_start is not None:
                self._add_damage(damage_start, event.offset)
                damage_start = None
            has_events = True
            yield event
        self.offset = window.offset
        if damage_start is not None:
            self._add_damage(damage_start, window.offset)
        if not has_events:
            what = f"has {window.offset} bytes without an LCM event" if window.offset else "is empty"
            raise TakeError(f"{safe_text(str(self.path))} {what}; choose a recording (.lcmlog)")

    def _add_damage(self, start: int, stop: int) -> None:
        if len(self.damage) < MAX_LISTED_DAMAGE:
            self.damage.append(Damage(self.path, start, stop - start))
        self.num_damaged += 1
        self.damaged_bytes += stop - start


def open_file(path: Path) -> BinaryIO:
    """Open a regular file to read it. Raises OSError, also if it is something else, and ValueError."""
    check_is_file(path)
    # With O_NONBLOCK, this does not wait for a writer if a pipe has replaced the file since the check.
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb", buffering=0)


class EventBoundary:
    """Finds the end of the last complete event in a log that arrives in pieces.

    After damage, everything counts as complete.
    """

    def __init__(self) -> None:
        self._num_bytes = 0
        self._complete_bytes = 0  # also where the present event begins
        self._header = bytearray()  # its beginning
        self._end = 0  # of the present event, once its header is complete
        self._is_damaged = False

    @property
    def complete_bytes(self) -> int:
        """How many bytes the complete events have together."""
        return self._num_bytes if self._is_damaged else self._complete_bytes

    def feed(self, data: bytes) -> None:
        """Take the next bytes of the log."""
        start = self._num_bytes
        self._num_bytes += len(data)
        while not self._is_damaged:
            missing = _HEADER.size - len(self._header)
            if missing:
                place = self._complete_bytes + len(self._header) - start
                self._header += data[place : place + missing]
                if len(self._header) < _HEADER.size:
                    break
                fields = _plausible_header(self._header)
                self._is_damaged = fields is None
                self._end = self._complete_bytes + _HEADER.size + sum(fields[3:] if fields else ())
            if self._end > self._num_bytes:
                break
            self._complete_bytes = self._end
            self._header.clear()


class _Window:
    """A part of a file in memory, which moves forward. ``offset`` is the present place in the file."""

    def __init__(self, file: BinaryIO, offset: int, stop_offset: int | None = None) -> None:
        self._file = file
        self._stop_offset = stop_offset
        self._names: dict[bytes, str] = {}
        self._data = b""
        self._start = 0  # of the present place in _data
        self.offset = offset
        if stop_offset is None:
            os.posix_fadvise(file.fileno(), offset, _AHEAD_BYTES, os.POSIX_FADV_WILLNEED)

    def has(self, num_bytes: int) -> bool:
        """Whether the file has this many more bytes; they are in memory then."""
        while (missing := self._start + num_bytes - len(self._data)) > 0:
            if self._stop_offset is None:
                num_wanted = max(missing, _READ_BYTES)
                ahead = self._file.tell() + num_wanted + _AHEAD_BYTES
                os.posix_fadvise(self._file.fileno(), ahead, _READ_BYTES, os.POSIX_FADV_WILLNEED)
            else:
                num_wanted = min(max(missing, _PIECE_BYTES), self._stop_offset - self._file.tell())
            more = self._file.read(num_wanted)
            if not more:
                break
            self._data = self._data[self._start :] + more
            self._start = 0
        return len(self._data) - self._start >= num_bytes

    def intact_events(self, columns: Mapping[bytes, EventColumns]) -> Iterator[Event]:
        """Yield or collect the next events, as far as each is in memory and another one follows directly.

        This is the fast way through a log without damage; ``event`` has all the rules.
        """
        data, start = self._data, self._start
        to_offset = self.offset - start
        last_header = len(data) - _HEADER.size
        unpack, new_event, names = _HEADER.unpack_from, tuple.__new__, self._names
        if start > last_header:
            return
        sync, number, utime, channel_bytes, message_bytes = unpack(data, start)
        while (
            sync == SYNC
            and 0 < channel_bytes <= MAX_CHANNEL_BYTES
            and 0 <= message_bytes <= MAX_MESSAGE_BYTES
        ):
            message_start = start + _HEADER_BYTES + channel_bytes
            stop = message_start + message_bytes
            if stop > last_header:
                break
            sync, next_number, next_utime, next_channel_bytes, next_message_bytes = unpack(data, stop)
            if sync != SYNC:
                break
            if columns and (
                found := columns.get(data[start + _HEADER_BYTES : message_start + _FINGERPRINT_BYTES])
            ):
                found.utimes.append(utime)
                found.messages.append(data[message_start:stop])
            else:
                channel = data[start + _HEADER_BYTES : message_start]
                name = names.get(channel) or self._name(channel)
                if name is None:
                    break
                yield new_event(Event, (number, utime, name, data[message_start:stop], to_offset + start))
            start = stop
            number, utime = next_number, next_utime
            channel_bytes, message_bytes = next_channel_bytes, next_message_bytes
        self.move(start - self._start)

    def _name(self, channel: bytes) -> str | None:
        try:
            name = channel.decode()
        except UnicodeDecodeError:
            return None
        if len(self._names) < _MAX_NAMES:
            self._names[channel] = name
        return name

    def event(self) -> Event | None:
        """Return the event at the present place and move behind it; None, without moving, if damaged."""
        header = self._header()
        if header is None:
            return None
        _, number, utime, channel_bytes, message_bytes = header
        size = _HEADER.size + channel_bytes + message_bytes
        if not self.has(size):
            return None
        self.has(size + len(SYNC))
        # What follows confirms the size. If it is no event, and one begins inside of this event, the end of
        # this one is lost, or its size is wrong.
        follows = self._data[self._start + size : self._start + size + len(SYNC)]
        inside = -1 if SYNC.startswith(follows) else self._find_sync(len(SYNC), size)
        while inside >= 0:
            if self._header(inside) is not None:
                return None
            inside = self._find_sync(inside + 1, size)
        message_start = self._start + size - message_bytes
        try:
            name = self._data[message_start - channel_bytes : message_start].decode()
        except UnicodeDecodeError:
            return None
        event = Event(number, utime, name, self._data[message_start : self._start + size], self.offset)
        self.move(size)
        return event

    def _header(self, ahead: int = 0) -> tuple[bytes, int, int, int, int] | None:
        """Return the fields of a plausible header ``ahead`` bytes from here; None if there is none."""
        return _plausible_header(self._data, self._start + ahead) if self.has(ahead + _HEADER.size) else None

    def _find_sync(self, ahead: int, stop: int) -> int:
        """Return how many bytes from here the next sync word begins; -1 if none begins before ``stop``."""
        self.has(stop + len(SYNC) - 1)
        found = self._data.find(SYNC, self._start + ahead, self._start + stop + len(SYNC) - 1)
        return found - self._start if found >= 0 else -1

    def move(self, num_bytes: int) -> None:
        """Go forward."""
        self._start += num_bytes
        self.offset += num_bytes

    def skip_to_sync(self) -> None:
        """Go forward by at least one byte, to the next sync word or the end of the file."""
        self.has(_READ_BYTES)
        rest = len(self._data) - self._start
        found = self._data.find(SYNC, self._start + 1)
        if found >= 0:
            self.move(found - self._start)
        elif rest < _READ_BYTES:
            self.move(rest)
        else:
            self.move(rest - len(SYNC) + 1)
            self._skip_hole()

    def _skip_hole(self) -> None:
        """Go to the next data if the file has a hole here: many GB of zeros that are not on the disk."""
        descriptor, position = self._file.fileno(), self._file.tell()
        try:
            data = os.lseek(descriptor, position, os.SEEK_DATA)
        except OSError:  # there is none
            data = os.lseek(descriptor, 0, os.SEEK_END)
        if data > position:
            # What is left in memory, three bytes, cannot begin a sync word that goes on with zeros.
            self._data, self._start, self.offset = b"", 0, data
        else:
            os.lseek(descriptor, position, os.SEEK_SET)


def _plausible_header(data: bytes | bytearray, offset: int = 0) -> tuple[bytes, int, int, int, int] | None:
    """Return the fields of the header at ``offset``; None if they cannot be those of one."""
    fields: tuple[bytes, int, int, int, int] = _HEADER.unpack_from(data, offset)
    sync, _, _, channel_bytes, message_bytes = fields
    is_plausible = (
        sync == SYNC and 0 < channel_bytes <= MAX_CHANNEL_BYTES and 0 <= message_bytes <= MAX_MESSAGE_BYTES
    )
    return fields if is_plausible else None
