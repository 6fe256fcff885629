"""Foxglove's WebSocket protocol: the messages of the server, and the requests of clients.

The protocol is described in the repository foxglove/ws-protocol (docs/spec.md). Its two names mean the same:
clients made before 2026, such as Lichtblick 1.21, know the first one only, and newer ones the second.
"""

import base64
import json
import struct
from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from gateway.errors import QueryError
from gateway.foxglove_schemas.topics import Topic
from gateway.messages.json_text import json_text

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_MESSAGE_DATA: Final = struct.Struct("<BIQ")
"""Opcode, id of the subscription, time in ns since 1970; the message follows."""

_MESSAGE_DATA_OPCODE: Final = 1
_MAX_ID: Final = (1 << 32) - 1
_WARNING: Final = 1
_ERROR: Final = 2


class Subscription(NamedTuple):
    """The client chooses ``number``; the messages on ``channel`` have it."""

    number: int
    channel: int


class Request(NamedTuple):
    """What a client asks for: to begin subscriptions, and to end those with these numbers."""

    subscriptions: tuple[Subscription, ...] = ()
    ended: tuple[int, ...] = ()


def server_info(name: str, session: str) -> str:
    """Return the first message to a client. With another ``session``, it forgets all earlier messages."""
    return json_text({"op": "serverInfo", "name": name, "capabilities": [], "sessionId": session})


def channel_text(number: int, topic: Topic) -> str:
    """Return a channel for ``advertise``."""
    is_text = topic.schema_encoding in {"jsonschema", "ros2msg"}
    return json_text(
        {
            "id": number,
            "topic": topic.name,
            "encoding": topic.encoding,
            "schemaName": topic.schema_name,
            "schemaEncoding": topic.schema_encoding,
            "schema": topic.schema.decode() if is_text else base64.b64encode(topic.schema).decode(),
        }
    )


def advertise(channels: Iterable[str]) -> str:
    """Return the message that announces channels, which ``channel_text`` has made."""
    return f'{{"op":"advertise","channels":[{",".join(channels)}]}}'


def unadvertise(numbers: list[int]) -> str:
    """Return the message that withdraws channels."""
    return json_text({"op": "unadvertise", "channelIds": numbers})


def warning(text: str) -> str:
    """Return the message that shows a warning in the viewer."""
    return json_text({"op": "status", "level": _WARNING, "message": text})


def error(text: str) -> str:
    """Return the message that shows an error in the viewer."""
    return json_text({"op": "status", "level": _ERROR, "message": text})


def message_data(subscription: int, utime: int, data: bytes) -> bytes:
    """Return a message of a channel; ``utime`` is in µs since 1970."""
    return _MESSAGE_DATA.pack(_MESSAGE_DATA_OPCODE, subscription, utime * 1000) + data


def parse_request(message: str | bytes) -> Request:
    """Return what a client asks for.

    Raises QueryError for anything but subscriptions: the server announces no other capability.
    """
    if isinstance(message, bytes):
        raise QueryError("binary messages are not accepted")
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise QueryError("a message is not JSON") from None
    match content:
        case {"op": "subscribe", "subscriptions": list(subscriptions)}:
            return Request(subscriptions=tuple(_subscription(found) for found in subscriptions))
        case {"op": "unsubscribe", "subscriptionIds": list(numbers)}:
            return Request(ended=tuple(_number(number) for number in numbers))
    raise QueryError("only subscribe and unsubscribe are served")


def _subscription(content: Any) -> Subscription:
    match content:
        case {"id": number, "channelId": channel}:
            return Subscription(_number(number), _number(channel))
    raise QueryError("a subscription needs id and channelId")


def _number(value: Any) -> int:
    # JavaScript has no integers, so a client may write 1.0.
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and 0 <= value <= _MAX_ID and value == int(value):
        return int(value)
    raise QueryError(f"an id is not a whole number from 0 to {_MAX_ID}")
