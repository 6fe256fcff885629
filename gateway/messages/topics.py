"""Zenoh key expressions and LCM channels of everything the gateway publishes."""

import re
from collections.abc import Container
from typing import Final, NamedTuple
from urllib.parse import quote

DEFAULT_LCM_PREFIX: Final = "MOCAP"

MAX_SOURCES: Final = 256
"""How many sources a program receives, records or finds in a take: anybody on a network can send some."""

MAX_CHANNEL_LENGTH = 63
"""LCM's ``publish`` refuses longer names."""

MAX_LABEL_LENGTH = 200
"""A tool's label comes from the server and becomes part of a key; Zenoh panics over keys of 64 kB."""

JSON_NAME = "json"
"""The last part of a key with JSON: the key of a component or of a tool, then this. No tool is called so."""


class Topic(NamedTuple):
    """A series of messages of one LCM type from ``source``, with a key on Zenoh and a channel on LCM.

    ``path`` is the part of the key below the source: ("3d",), ("6d",), ("analog",), ("force",), ("event",),
    ("status",), ("clock",), or ("6d", label) for the pose of one tool. ``type_name`` is the name of the LCM
    type, such as "rtc3d.markers_t".
    """

    source: str
    path: tuple[str, ...]
    type_name: str


def zenoh_key(prefix: str, source: str, *path: str) -> str:
    """Return the key ``prefix/source/path…`` with each chunk of ``path`` escaped."""
    return "/".join([prefix, source, *(escape_key_chunk(name) for name in path)])


def is_json_key(key: str) -> bool:
    """Return whether this is a Zenoh key of JSON."""
    return key.endswith(f"/{JSON_NAME}")


def escape_key_chunk(label: str) -> str:
    """Return ``label`` as one chunk of a key expression (a part between slashes), without loss.

    ASCII letters, digits and ``_ . - ~`` stay. Everything else is percent-escaped (UTF-8), including
    ``/ * $ # ?`` of Zenoh's syntax. ``urllib.parse.unquote`` returns the label. An empty label becomes
    ``%``, which is not an escape sequence.
    """
    return quote(label, safe="") or "%"


def lcm_channel(prefix: str, source: str, *path: str) -> str:
    """Return the channel ``prefix_SOURCE_PATH…``, cut to MAX_CHANNEL_LENGTH.

    After ``prefix`` it has only upper-case ASCII letters, digits and ``_``. Two labels can give the same
    channel: see ``unique_name``.
    """
    names = (re.sub(r"[^A-Z0-9]+", "_", name.upper()).strip("_") or "_" for name in (source, *path))
    return "_".join([prefix, *names])[:MAX_CHANNEL_LENGTH]


def unique_name(name: str, taken: Container[str], max_length: int = MAX_CHANNEL_LENGTH) -> str:
    """Return ``name`` if it is not ``taken``, otherwise the first free one of ``name_2``, ``name_3``, …

    The result has at most ``max_length`` characters; if necessary, the name is cut, not the number.
    """
    candidate, number = name[:max_length], 1
    while candidate in taken:
        number += 1
        suffix = f"_{number}"
        candidate = name[: max_length - len(suffix)] + suffix
    return candidate
