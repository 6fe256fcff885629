"""Component → LCM message: the type's fingerprint, a prefix of ours, the component's own bytes.

LCM writes big-endian without padding and RTC3D sends big-endian, so the message types of lcm_types/
have the component's own fields in its own order, and no value is decoded or encoded.
"""

import math
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import rtc3d

from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
    Items,
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

STAMP: Final = struct.Struct(">qqqi")
"""What follows the fingerprint: utime, capture_utime, sequence, session."""

_pack_stamp: Final = STAMP.pack
_NO_SEQUENCE: Final = 1 << 63  # none is as great: they are signed and have 64 bits

PREFIX_BYTES: Final = FINGERPRINT_BYTES + STAMP.size
"""36: what of a message is ours; the component's own bytes follow."""

MESSAGE_HEADER_BYTES: Final = PREFIX_BYTES + 16
"""Where the items begin: after the prefix, frame number, time stamp and count."""

FINGERPRINTS: Final[dict[ComponentType, bytes]] = {
    component: message_type._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
    for component, message_type in MESSAGE_TYPES.items()
}
"""The first 8 bytes of each component's messages: lcm-gen's hash of the type."""

_POSE_FINGERPRINT: Final[bytes] = rtc3d.tool_pose_t._get_packed_fingerprint()  # noqa: SLF001 - as above
# Frame number, time stamp, visible, position, orientation, error.
_POSE: Final = struct.Struct(">iq?8f")
_METRES: Final = {"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "in": 0.0254}


class Stamp:
    """When a frame came and was captured (µs since the Unix epoch), and in which connection.

    ``has_clock`` is whether the server's time stamps make a clock; else its times tell nothing.
    """

    __slots__ = ("_packed", "_sequence", "capture_utime", "has_clock", "session", "utime")

    def __init__(self, utime: int, capture_utime: int, session: int, has_clock: bool = True) -> None:
        self.utime = utime
        self.capture_utime = capture_utime
        self.session = session
        self.has_clock = has_clock
        self._sequence = _NO_SEQUENCE  # the one in _packed
        self._packed = b""

    def packed(self, sequence: int) -> bytes:
        """Return what follows the fingerprint in a message with this number: 28 bytes.

        Of one frame most messages have the same number: the bytes are kept.
        """
        if sequence != self._sequence:
            self._sequence = sequence
            self._packed = _pack_stamp(self.utime, self.capture_utime, sequence, self.session)
        return self._packed


def type_name(message_type: type[Any]) -> str:
    """Return the LCM type's name as lcm-gen and Zenoh's encoding schema have it: rtc3d.markers_t."""
    return f"rtc3d.{message_type.__name__}"


def splice(component: Component, stamp: Stamp, sequence: int) -> bytes:
    """Return the component's LCM message; sizes and counts were checked when its frame was split.

    The fan-out does the same, with FINGERPRINTS, for contents that are canonical as they come.
    """
    return FINGERPRINTS[component.type] + stamp.packed(sequence) + canonical_content(component)


def is_canonical(part: ComponentLayout, byte_order: ByteOrder) -> bool:
    """Return whether the contents of such components go into messages as they come."""
    return byte_order == "big" and part.item_bytes == ITEM_DTYPES[part.type].itemsize


def canonical_content(component: Component) -> bytes:
    """Return the content in big-endian form, events with 24 bytes each (field note 6)."""
    if component.type is not ComponentType.EVENT or component.item_bytes != SHORT_EVENT.itemsize:
        return big_endian_content(component)
    short = component.items()
    events = np.empty(len(short), LONG_EVENT)
    for name in SHORT_EVENT.names or ():
        events[name] = short[name]
    events["timestamp"] = component.timestamp_us
    header = struct.pack(">iqI", component.frame_number, component.timestamp_us, len(events))
    return header + events.tobytes()


def timestamp_us_of(content: bytes) -> int:
    """Return the time stamp of a canonical content."""
    return int.from_bytes(content[4:12], "big", signed=True)


def metres_per_unit(unit: str) -> float | None:
    """Return how many metres one ``unit`` of the 3D parameters is (§6.2); None for an unknown unit."""
    return _METRES.get(unit.strip().lower() or "mm")


def tool_poses(
    component: Component, stamp: Stamp, sequences: Sequence[int], metres: float = 1e-3
) -> list[bytes]:
    """Return one ``tool_pose_t`` message per tool of a 6D component: SI units, scalar last.

    ``sequences`` holds one sequence number per tool; ``metres`` is the size of the component's unit.
    """
    return [
        _POSE_FINGERPRINT + stamp.packed(sequence) + _pose(component, tool, metres)
        for tool, sequence in zip(component.items().tolist(), sequences, strict=True)
    ]


def _pose(component: Component, tool: tuple[float, ...], metres: float) -> bytes:
    q0, qx, qy, qz, x, y, z, error = tool
    # Any NaN means missing (field note 7); a robot is never given half a pose.
    visible = not any(map(math.isnan, tool))
    if not visible:
        pose = (math.nan,) * 8
    else:
        pose = (x * metres, y * metres, z * metres, qx, qy, qz, q0, error * metres)
    return _POSE.pack(component.frame_number, component.timestamp_us, visible, *pose)


def message_items(message: bytes, component: ComponentType) -> Items:
    """Return the items of a component's message, shape (num_items,), as a read-only view of it.

    The dtype is that of ITEM_DTYPES. For subscribers that do without lcm-gen; the message must come
    from a gateway.
    """
    return np.frombuffer(message, ITEM_DTYPES[component], offset=MESSAGE_HEADER_BYTES)
