"""What describes a take in its files: who and what it is about, its sources, and how much is missing."""

import socket
from dataclasses import dataclass
from typing import Final, NamedTuple

import rtc3d

from gateway import __version__
from gateway.errors import QueryError
from gateway.messages.texts import encode_within_limits
from gateway.messages.topics import lcm_channel
from gateway.runtime.safe_text import quoted

_HAS_END: Final = "ends with take_end_t"
"""What ``take_t`` says of its recorder. Earlier versions did not write the end of a file."""

MAX_DETAIL_CHARACTERS: Final = {"subject": 64, "session": 64, "note": 500}
"""The details of a take by name, and how long each may be."""


class TakeDetails(NamedTuple):
    """Who and what a take is about; "" is what nobody said."""

    subject: str = ""
    session: str = ""
    note: str = ""

    def checked(self) -> "TakeDetails":
        """Return the details without spaces around them. Raises QueryError if a file cannot have them."""
        details = TakeDetails(*map(str.strip, self))
        for (name, maximum), text in zip(MAX_DETAIL_CHARACTERS.items(), details, strict=True):
            if len(text) > maximum or not text.isprintable():
                raise QueryError(
                    f"the {name} {quoted(text)} is not accepted; accepted: up to {maximum} characters, "
                    "without line ends and other control characters"
                )
        return details

    @property
    def text(self) -> str:
        """All of them for people, such as "subject S01, session baseline: left knee"; "" without any."""
        named = [f"{name} {text}" for name, text in zip(self._fields[:2], self[:2], strict=True) if text]
        return ": ".join(filter(None, (", ".join(named), self.note)))


NO_DETAILS: Final = TakeDetails()


@dataclass(frozen=True)
class SourceDescription:
    """A source in the files of a take: what each file says of it at its beginning and at its end.

    ``channels`` is the beginning of its channels, such as MOCAP_LAB. ``server`` is HOST:PORT, "" if it is not
    known. ``recorder`` is the program that records, without its version.
    """

    source: str
    channels: str
    server: str = ""
    gateway_version: str = __version__
    recorder: str = "rtc3d-gateway"
    details: TakeDetails = NO_DETAILS

    def channel(self, *path: str) -> bytes:
        """Return the channel of the key with this path."""
        return lcm_channel(self.channels, *path).encode()

    def beginning(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return the ``take_t``, and the ``take_details_t`` if there are details, each with its channel.

        They are for a file of the take ``name`` that begins at ``utime``, in µs since the Unix epoch.
        docs/reference/messages.md describes their fields.
        """
        take = rtc3d.take_t()
        take.utime = utime
        take.name = name
        take.source, take.channels = self.source, self.channels
        take.server, take.gateway_version = self.server, self.gateway_version
        take.recorder = f"{self.recorder} {__version__}, {_HAS_END}"
        take.host = socket.gethostname()
        messages = [(self.channel("take"), encode_within_limits(take))]
        if self.details != NO_DETAILS:
            about = rtc3d.take_details_t()
            about.utime, about.source = utime, self.source
            about.subject, about.session, about.note = self.details
            messages.append((self.channel("details"), encode_within_limits(about)))
        return messages

    def end(self, utime: int, num_lost: int) -> tuple[bytes, bytes]:
        """Return the ``take_end_t`` of a file that lacks ``num_lost`` published messages, and its channel."""
        end = rtc3d.take_end_t()
        end.utime, end.source, end.messages_lost = utime, self.source, num_lost
        return self.channel("end"), encode_within_limits(end)


def has_end(take: rtc3d.take_t) -> bool:
    """Return whether a file that begins with this ``take_t`` has a ``take_end_t``, unless it was cut off."""
    return _HAS_END in take.recorder


def decoded_details(message: rtc3d.take_details_t) -> TakeDetails:
    """Return the details in a message."""
    return TakeDetails(message.subject, message.session, message.note)
