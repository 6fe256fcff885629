"""Zenoh key expressions and LCM channels of everything that is published, and the cleaning of labels."""

import re
from collections.abc import Container
from typing import NamedTuple
from urllib.parse import quote

MAX_CHANNEL_LENGTH = 63
"""What LCM allows; a longer name is refused by ``publish``."""

MAX_LABEL_LENGTH = 200
"""What is kept of a tool's label, which is the server's word: Zenoh panics over keys of 64 kB."""


class Topic(NamedTuple):
    """One stream of messages: of ``source``, under ``parts`` (its name on both sides), of one LCM type.

    ``parts`` is one of ("3d",), ("6d",), ("analog",), ("force",), ("event",), ("status",), or
    ("6d", label) for the pose of one tool. ``type_name`` is the LCM type: "rtc3d.markers_t".
    """

    source: str
    parts: tuple[str, ...]
    type_name: str


def zenoh_key(prefix: str, source: str, *parts: str) -> str:
    """Return the key PREFIX/SOURCE/PART…; what Zenoh refuses in a part is percent-escaped (UTF-8)."""
    return "/".join([prefix, source, *(escape_key_chunk(part) for part in parts)])


def escape_key_chunk(label: str) -> str:
    """Return ``label`` as one chunk of a key expression, losslessly.

    Letters, digits and ``_ . - ~`` stay; everything else is percent-escaped, ``/ * $ # ?`` of Zenoh's
    syntax among it. ``urllib.parse.unquote`` gives the label back. An empty label becomes ``%``,
    which is no escape of anything.
    """
    return quote(label, safe="") or "%"


def lcm_channel(prefix: str, source: str, *parts: str) -> str:
    """Return the channel PREFIX_SOURCE_PART…; behind ``prefix`` only upper-case ASCII, digits and ``_``.

    It is cut to MAX_CHANNEL_LENGTH. Two labels can give one channel: see ``unique_name``.
    """
    names = (_channel_part(part) for part in (source, *parts))
    return "_".join([prefix, *names])[:MAX_CHANNEL_LENGTH]


def unique_name(name: str, taken: Container[str], max_length: int = MAX_CHANNEL_LENGTH) -> str:
    """Return ``name``, or with ``_2``, ``_3``, … behind it the first that is not ``taken``.

    It is cut to ``max_length``, the number included.
    """
    candidate, number = name[:max_length], 1
    while candidate in taken:
        number += 1
        suffix = f"_{number}"
        candidate = name[: max_length - len(suffix)] + suffix
    return candidate


def _channel_part(text: str) -> str:
    return re.sub(r"[^A-Z0-9]+", "_", text.upper()).strip("_") or "_"
