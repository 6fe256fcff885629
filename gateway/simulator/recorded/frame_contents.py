"""Recorded components as the bytes of data frames, in the byte order that a client wants."""

import struct
from collections.abc import Sequence
from typing import Final

import numpy as np

from gateway.rtc3d.components import (
    ITEM_DTYPES,
    SHORT_EVENT,
    ByteOrder,
    ComponentType,
    Items,
    encode_component,
)

_HEAD: Final = struct.Struct(">iqi")
"""The fields of a content before its items: frame number, time stamp in µs, number of items."""

_SIZE_AND_TYPE: Final = struct.Struct(">II")
_SIZE_AND_TYPE_BYTES: Final = 8


def is_whole(component: ComponentType, content: bytes) -> bool:
    """Return whether a recorded content has as many items as it says."""
    if len(content) < _HEAD.size:
        return False
    return len(content) == _HEAD.size + num_items(content) * ITEM_DTYPES[component].itemsize


def num_items(content: bytes) -> int:
    """Return the number of items in a content."""
    count: int = _HEAD.unpack_from(content)[2]
    return count


def items(component: ComponentType, content: bytes) -> Items:
    """Return the items of a content, shape (items,), as in ITEM_DTYPES."""
    return np.frombuffer(content, ITEM_DTYPES[component], offset=_HEAD.size)


def component_bytes(
    component: ComponentType, contents: Sequence[bytes], byte_order: ByteOrder, event_bytes: int
) -> bytes:
    """Return the bytes of a component (§7.1) from its recorded content.

    Several contents, which only events have, become one component with all their items, and with the frame
    number and time stamp of the last one. ``event_bytes`` is 24 or 16.
    """
    is_short = component is ComponentType.EVENT and event_bytes == SHORT_EVENT.itemsize
    content = contents[-1]
    if byte_order == "big" and len(contents) == 1 and not is_short:
        return _SIZE_AND_TYPE.pack(_SIZE_AND_TYPE_BYTES + len(content), component) + content
    values = np.concatenate([items(component, each) for each in contents])
    if is_short:
        values = values[list(SHORT_EVENT.names or ())].astype(SHORT_EVENT)
    frame_number, timestamp_us, _ = _HEAD.unpack_from(content)
    return encode_component(component, frame_number, timestamp_us, values, byte_order)
