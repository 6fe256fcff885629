"""The server's parameters as a message, the same on LCM and in takes."""

from typing import Final

import rtc3d

from gateway.messages.texts import xml_text
from gateway.outputs.contract import ServerParameters

_UTIME: Final = slice(8, 16)


def encode_parameters(
    parameters: ServerParameters, *, utime: int, arrived_utime: int, sequence: int
) -> bytes:
    """Return a ``parameters_t``.

    ``utime`` is when it is published, ``arrived_utime`` when the parameters arrived from the server, both in
    µs since the Unix epoch.
    """
    message = rtc3d.parameters_t()
    message.utime, message.capture_utime = utime, arrived_utime
    message.sequence = sequence
    message.session, message.parameters_version = parameters.session, parameters.version
    message.xml = xml_text(parameters.xml)
    encoded: bytes = message.encode()
    return encoded


def published_again(message: bytes, utime: int) -> bytes:
    """Return an encoded ``parameters_t`` as of a later time, in µs since the Unix epoch."""
    return message[: _UTIME.start] + utime.to_bytes(8, "big", signed=True) + message[_UTIME.stop :]
