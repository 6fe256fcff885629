"""What describes a source at the beginning and at the end of a file."""

import socket
from typing import Final

import rtc3d

from gateway import __version__
from gateway.messages.limits import encode_within_limits

_HAS_END: Final = "ends with take_end_t"
"""What ``take_t`` says of its recorder. Earlier versions did not write the end of a file."""


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


def encode_take_end(*, utime: int, source: str, messages_lost: int) -> bytes:
    """Return a ``take_end_t``: how many messages of ``source`` were published, but are not in the file."""
    message = rtc3d.take_end_t()
    message.utime, message.source, message.messages_lost = utime, source, messages_lost
    return encode_within_limits(message)
