"""Decoding LCM messages of the gateway, and converting them to JSON."""

import math
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ProtocolError
from gateway.messages.encode import FINGERPRINT_BYTES
from gateway.messages.stamp import PREFIX

MESSAGE_TYPES_BY_NAME: Final[dict[str, type[Any]]] = {
    message_type.__name__: message_type
    for message_type in (
        rtc3d.markers_t,
        rtc3d.tools_t,
        rtc3d.analog_t,
        rtc3d.forces_t,
        rtc3d.events_t,
        rtc3d.tool_pose_t,
        rtc3d.status_t,
        rtc3d.clock_t,
        rtc3d.parameters_t,
        rtc3d.parameters_request_t,
        rtc3d.parameters_reply_t,
        rtc3d.command_request_t,
        rtc3d.command_reply_t,
        rtc3d.take_t,
        rtc3d.take_details_t,
        rtc3d.take_end_t,
    )
}
"""The types of all messages that the gateway publishes, receives on LCM, or writes to recordings."""

_MESSAGE_TYPES_BY_FINGERPRINT: Final = {
    message_type._get_packed_fingerprint(): message_type  # noqa: SLF001 - lcm-gen offers no other way
    for message_type in MESSAGE_TYPES_BY_NAME.values()
}


class Prefix(NamedTuple):
    """The prefix of a message; docs/reference/messages.md describes the fields."""

    utime: int
    capture_utime: int
    sequence: int
    session: int
    parameters_version: int


def prefix_of(message: bytes) -> Prefix:
    """Return the prefix of one of the gateway's messages."""
    return Prefix(*PREFIX.unpack_from(message, FINGERPRINT_BYTES))


def message_type(message: bytes) -> type[Any]:
    """Return the LCM type that the message's fingerprint stands for.

    Raises ProtocolError if it is not one of the gateway's types.
    """
    found = _MESSAGE_TYPES_BY_FINGERPRINT.get(message[:8])
    if found is None:
        raise ProtocolError(
            f"{len(message)} bytes with fingerprint {message[:8].hex()} are not a message of this gateway; "
            "does another program, or another version of the gateway, publish here?"
        )
    return found


def decode(message: bytes) -> Any:
    """Return the message as an object of its LCM type.

    Raises ProtocolError if its type is not one of the gateway's, or its length is wrong.
    """
    lcm_type = message_type(message)
    try:
        decoded = lcm_type.decode(message)
        # lcm-gen's decoders read a truncated string as a shorter one. So messages with strings are encoded
        # again and compared. This fails for signalling NaNs only, and types with strings contain none.
        is_whole = "string" not in lcm_type.__typenames__ or decoded.encode() == message
    except Exception as error:  # lcm-gen's decoders raise many kinds of exceptions
        raise ProtocolError(f"a {lcm_type.__name__} message of {len(message)} bytes is truncated") from error
    if not is_whole:
        raise ProtocolError(f"a {lcm_type.__name__} message of {len(message)} bytes is truncated or too long")
    return decoded


def to_json(value: Any) -> Any:
    """Return an LCM object, or a list or value in one, as values that ``json`` can write.

    NaN and infinity become None.
    """
    if hasattr(value, "__slots__"):
        return {name: to_json(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
