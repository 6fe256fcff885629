"""LCM messages of components: the type's fingerprint, the gateway's prefix, the component's content.

LCM writes big-endian without padding, and RTC3D sends big-endian. The message types in lcm_types/ have the
component's own fields in the same order, so the content is copied and no value is decoded or encoded.

A content in *LCM form* can be copied: it is big-endian, with events of 24 bytes (field note 6).
"""

import struct
from typing import Any, Final

import numpy as np
import rtc3d

from gateway.messages.stamp import PREFIX, Stamp
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
    big_endian_content,
)
from gateway.rtc3d.frames import ComponentLayout

MESSAGE_TYPES: Final[dict[ComponentType, type[Any]]] = {
    ComponentType.MARKERS: rtc3d.markers_t,
    ComponentType.TOOLS: rtc3d.tools_t,
    ComponentType.ANALOG: rtc3d.analog_t,
    ComponentType.FORCE: rtc3d.forces_t,
    ComponentType.EVENT: rtc3d.events_t,
}
"""The LCM type of each component's messages."""

FINGERPRINT_BYTES: Final = 8

CONTENT_OFFSET: Final = FINGERPRINT_BYTES + PREFIX.size
"""The offset of the component's content in a message: 40."""

VERSION_OFFSET: Final = CONTENT_OFFSET - 4
"""The offset of the version of the parameters; in a ``parameters_t``, the XML follows it."""

COUNT_OFFSET: Final = CONTENT_OFFSET + 12
"""The offset of the number of items, after frame number and time stamp: 52."""

ITEMS_OFFSET: Final = COUNT_OFFSET + 4
"""The offset of the items: 56."""

_SEQUENCE_OFFSET: Final = FINGERPRINT_BYTES + 16
_TIMESTAMP_OFFSET: Final = CONTENT_OFFSET + 4

_FINGERPRINTS: Final[dict[ComponentType, bytes]] = {
    component: message_type._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
    for component, message_type in MESSAGE_TYPES.items()
}


def lcm_type_name(message_type: type[Any]) -> str:
    """Return the LCM type's name as in the encoding of Zenoh samples: "rtc3d.markers_t"."""
    return f"rtc3d.{message_type.__name__}"


def encode_message(component: Component, stamp: Stamp, sequence: int) -> bytes:
    """Return the component's LCM message; ``split_frame`` has checked its size and count."""
    return encode_content(component.type, lcm_content(component), stamp, sequence)


def encode_content(component_type: ComponentType, content: bytes, stamp: Stamp, sequence: int) -> bytes:
    """Return the LCM message of a component whose content is in LCM form."""
    return b"%b%b%b" % (_FINGERPRINTS[component_type], stamp.prefix(sequence), content)


def has_lcm_form(layout: ComponentLayout, byte_order: ByteOrder) -> bool:
    """Return whether a component with this layout has its content in LCM form already."""
    return byte_order == "big" and layout.item_bytes == ITEM_DTYPES[layout.type].itemsize


def lcm_content(component: Component) -> bytes:
    """Return the component's content in LCM form; events of 16 bytes get the component's time stamp."""
    if component.type is not ComponentType.EVENT or component.item_bytes != SHORT_EVENT.itemsize:
        return big_endian_content(component)
    short = component.items()
    events = np.empty(len(short), LONG_EVENT)
    for name in SHORT_EVENT.names or ():
        events[name] = short[name]
    events["timestamp"] = component.timestamp_us
    header = struct.pack(">iqI", component.frame_number, component.timestamp_us, len(events))
    return header + events.tobytes()


def with_sequence(message: bytes, sequence: int) -> bytes:
    """Return a component's message with another sequence number."""
    number = sequence.to_bytes(8, "big", signed=True)
    return message[:_SEQUENCE_OFFSET] + number + message[_SEQUENCE_OFFSET + 8 :]


def message_timestamp_us(message: bytes) -> int:
    """Return the server's time stamp, in µs, from a component's message."""
    return int.from_bytes(message[_TIMESTAMP_OFFSET : _TIMESTAMP_OFFSET + 8], "big", signed=True)
