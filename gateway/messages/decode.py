"""Decoding LCM messages of the gateway, and converting them and the parameters to JSON.

``json.dumps`` keeps all other threads waiting from the first to the last byte: 24 ms for a frame of 10,000
markers, in which no frame is published. It is not faster either: for 1000 markers, ``to_json`` and
``json.dumps`` together take 3.7 ms, and ``json_text`` takes 3.2 ms.
"""

import json
from functools import cache
from json.encoder import encode_basestring
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import ProtocolError
from gateway.messages.encode import FINGERPRINT_BYTES, PREFIX

XML: Final = "application/xml"
JSON: Final = "application/json"
C3D: Final = "application/octet-stream"
LOG: Final = "application/octet-stream"
TEXT: Final = "text/plain"
LCM: Final = "application/x-lcm"
"""The encoding of every message; its schema is the LCM type: ``application/x-lcm;rtc3d.markers_t``."""

LCM_MESSAGES: Final = "application/x-lcm-messages"
"""The encoding of several messages in one answer (gateway.messages.history); its schema is their type."""


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as compact JSON in UTF-8. Raises ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


MAX_JSON_SOURCE_BYTES: Final = 1024 * 1024
"""Longer messages (65,000 markers) are not converted: the text would have six times as many bytes."""


def json_text(value: Any) -> str:
    """Return an LCM object, a dataclass with slots, or a list, dict or value of them, as compact JSON.

    NaN and infinity become null.
    """
    kind: Any = type(value)
    if kind is float:
        text = repr(value) if value - value == 0 else "null"
    elif kind is int:
        text = repr(value)
    elif kind is str:
        text = encode_basestring(value)
    elif kind is list or kind is tuple:
        text = f"[{','.join([json_text(item) for item in value])}]"
    elif kind is dict:
        items = [f"{encode_basestring(name)}:{json_text(item)}" for name, item in value.items()]
        text = f"{{{','.join(items)}}}"
    elif value is None or kind is bool:
        text = {None: "null", True: "true", False: "false"}[value]
    else:
        items = [key + json_text(getattr(value, name)) for name, key in _fields(kind)]
        text = f"{{{','.join(items)}}}"
    return text


@cache
def _fields(kind: Any) -> list[tuple[str, str]]:
    """Return the name of each field of a type, as it is and as a key in JSON."""
    return [(name, f"{encode_basestring(name)}:") for name in kind.__slots__]


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
    return json.loads(json_text(value))
