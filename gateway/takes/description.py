"""The description of a source at the beginning of a file."""

import socket

import rtc3d

from gateway import __version__
from gateway.messages.limits import encode_within_limits


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
    message.recorder = f"{recorder} {__version__}"
    message.host = socket.gethostname()
    return encode_within_limits(message)
