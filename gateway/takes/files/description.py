"""What describes a source at the beginning and at the end of a file."""

import socket
from typing import Final, NamedTuple

import rtc3d

from gateway import __version__
from gateway.errors import QueryError
from gateway.logs.safe_text import quoted
from gateway.messages.texts import encode_within_limits

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


def encode_take(
    *, utime: int, name: str, source: str, channels: str, server: str, gateway_version: str, recorder: str
) -> bytes:
    """Return a ``take_t``; docs/reference/messages.md describes its fields.

    ``recorder`` is the program that records, without its version.
    """
    message = rtc3d.take_t()
    message.utime = utime
    message.name = name
    message.source = source
    message.channels = channels
    message.server = server
    message.gateway_version = gateway_version
    message.recorder = f"{recorder} {__version__}, {_HAS_END}"
    message.host = socket.gethostname()
    return encode_within_limits(message)


def has_end(take: rtc3d.take_t) -> bool:
    """Return whether a file that begins with this ``take_t`` has a ``take_end_t``, unless it was cut off."""
    return _HAS_END in take.recorder


def encode_take_details(*, utime: int, source: str, details: TakeDetails) -> bytes:
    """Return a ``take_details_t``: who and what a take of ``source`` is about."""
    message = rtc3d.take_details_t()
    message.utime, message.source = utime, source
    message.subject, message.session, message.note = details
    return encode_within_limits(message)


def decoded_details(message: rtc3d.take_details_t) -> TakeDetails:
    """Return the details in a message."""
    return TakeDetails(message.subject, message.session, message.note)


def encode_take_end(*, utime: int, source: str, messages_lost: int) -> bytes:
    """Return a ``take_end_t``: how many messages of ``source`` were published, but are not in the file."""
    message = rtc3d.take_end_t()
    message.utime, message.source, message.messages_lost = utime, source, messages_lost
    return encode_within_limits(message)
