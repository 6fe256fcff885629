"""Topics and messages as Foxglove's programs take them, in a file or live."""

import json
from functools import cache
from typing import Any, Final, NamedTuple, Protocol

from foxglove import Schema
from foxglove.messages import Timestamp

MAX_UTIME: Final = ((1 << 32) - 1) * 1_000_000
"""The latest time that Foxglove's messages can have, in µs since 1970; the earliest is 0."""


class Topic(NamedTuple):
    """A topic and the type of its messages."""

    name: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


class FoxgloveMessage(NamedTuple):
    """One message. ``utime`` is its time in µs since 1970."""

    topic: Topic
    utime: int
    data: bytes


class MessageClass(Protocol):
    """A class of Foxglove's messages, such as foxglove.messages.PointCloud."""

    @staticmethod
    def get_schema() -> Schema:
        """Return the schema of its messages."""


@cache
def topic_of(name: str, message_class: MessageClass) -> Topic:
    """Return a topic with messages of one of Foxglove's own types."""
    schema = message_class.get_schema()
    return Topic(name, "protobuf", schema.name, schema.encoding, schema.data)


def json_topic(name: str, schema_name: str, schema: dict[str, Any]) -> Topic:
    """Return a topic with messages in JSON."""
    return Topic(name, "json", schema_name, "jsonschema", json.dumps(schema).encode())


def timestamp(utime: int) -> Timestamp:
    """Return a time in µs since 1970 as Foxglove's."""
    return Timestamp(utime // 1_000_000, utime % 1_000_000 * 1000)
