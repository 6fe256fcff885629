"""Zenoh key expressions and LCM channels of everything the gateway publishes."""

import re
from collections.abc import Container
from typing import NamedTuple
from urllib.parse import quote

MAX_CHANNEL_LENGTH = 63
"""LCM's limit: its ``publish`` refuses longer names."""

MAX_LABEL_LENGTH = 200
"""Limit on a tool's label, which the server chooses: Zenoh panics over keys of 64 kB."""


class Topic(NamedTuple):
    """One stream of messages of one LCM type from ``source``.

    ``path`` names the messages within the source, in keys and channels. It is one of ("3d",), ("6d",),
    ("analog",), ("force",), ("event",), ("status",), ("clock",), or ("6d", label) for the pose of one tool.
    ``type_name`` is the LCM type: "rtc3d.markers_t".
    """

    source: str
    path: tuple[str, ...]
    type_name: str


def zenoh_key(prefix: str, source: str, *path: str) -> str:
    """Return the key ``prefix/source/path…`` with every element of ``path`` escaped."""
    return "/".join([prefix, source, *(escape_key_chunk(name) for name in path)])


def escape_key_chunk(label: str) -> str:
    """Return ``label`` as one chunk of a key expression, without loss.

    Letters, digits and ``_ . - ~`` stay; everything else is percent-escaped (UTF-8), including ``/ * $ # ?``
    of Zenoh's syntax. ``urllib.parse.unquote`` returns the label. An empty label becomes ``%``, which is
    not an escape sequence.
    """
    return quote(label, safe="") or "%"


def lcm_channel(prefix: str, source: str, *path: str) -> str:
    """Return the channel ``prefix_SOURCE_PATH…``, cut to MAX_CHANNEL_LENGTH.

    After ``prefix`` it has only upper-case ASCII letters, digits and ``_``. Two labels can give the same
    channel: see ``unique_name``.
    """
    names = (_channel_name(name) for name in (source, *path))
    return "_".join([prefix, *names])[:MAX_CHANNEL_LENGTH]


def unique_name(name: str, taken: Container[str], max_length: int = MAX_CHANNEL_LENGTH) -> str:
    """Return ``name`` if it is not ``taken``, else the first free of ``name_2``, ``name_3``, …

    The result is cut to ``max_length`` characters; its number is kept.
    """
    candidate, number = name[:max_length], 1
    while candidate in taken:
        number += 1
        suffix = f"_{number}"
        candidate = name[: max_length - len(suffix)] + suffix
    return candidate


def _channel_name(text: str) -> str:
    return re.sub(r"[^A-Z0-9]+", "_", text.upper()).strip("_") or "_"
