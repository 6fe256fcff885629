"""LCM messages as the gateway publishes them: the type's fingerprint, the prefix, and the content.

LCM writes big-endian without padding, and RTC3D sends big-endian. The message types in lcm_types/ have the
component's own fields in the same order, so the content is copied and no value is decoded or encoded.

A content in *LCM form* can be copied: it is big-endian, with events of 24 bytes (field note 6).
"""

import math
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
    big_endian_content,
)
from gateway.rtc3d.frames import ComponentLayout, FrameLayout, RawFrame

PREFIX: Final = struct.Struct(">qqqii")
"""The fields after the fingerprint: utime, capture_utime, sequence, session, parameters_version."""

NOT_PUBLISHED: Final = -1
"""The sequence number of a message that only answers a query and is published on no output."""

_pack: Final = PREFIX.pack
_NO_SEQUENCE: Final = 1 << 63  # larger than any sequence number: those are signed 64-bit integers


class Stamp:
    """The part of the prefix that all messages of one frame share.

    ``utime`` is when the frame arrived and ``capture_utime`` when the server captured it, both in µs since
    the Unix epoch. ``session`` is the number of the connection. ``parameters_version`` grows whenever the
    server's parameters change; 0 before the first. ``has_clock`` is False if the server's time stamps cannot
    be used as a clock; then both times are equal.
    """

    __slots__ = (
        "_prefix",
        "_sequence",
        "capture_utime",
        "has_clock",
        "parameters_version",
        "session",
        "utime",
    )

    def __init__(
        self,
        utime: int,
        capture_utime: int,
        session: int,
        parameters_version: int,
        has_clock: bool = True,
    ) -> None:
        self.utime = utime
        self.capture_utime = capture_utime
        self.session = session
        self.parameters_version = parameters_version
        self.has_clock = has_clock
        self._sequence = _NO_SEQUENCE  # the number in _prefix
        self._prefix = b""

    def prefix(self, sequence: int) -> bytes:
        """Return the prefix, 32 bytes, of a message with this sequence number.

        Most messages of a frame have the same number, so it caches the last prefix (benchmarks/own_cost.py).
        """
        if sequence != self._sequence:
            self._sequence = sequence
            self._prefix = _pack(
                self.utime, self.capture_utime, sequence, self.session, self.parameters_version
            )
        return self._prefix


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
    return _FINGERPRINTS[component.type] + stamp.prefix(sequence) + lcm_content(component)


class ComponentEncoder:
    """Encodes the component at ``index`` of frames with one layout."""

    def __init__(self, layout: FrameLayout, index: int) -> None:
        self._index = index
        self._layout = layout
        self._fingerprint = _FINGERPRINTS[layout.components[index].type]
        self._start, self._end = layout.content_spans[index]
        self._has_lcm_form = has_lcm_form(layout.components[index], layout.byte_order)

    def message(self, body: bytes, prefix: bytes) -> bytes:
        """Return the LCM message, with this prefix, of the component in the body of a frame."""
        if self._has_lcm_form:
            content = body[self._start : self._end]
        else:
            content = lcm_content(RawFrame(self._layout, body).component(self._index))
        return b"%b%b%b" % (self._fingerprint, prefix, content)


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


_FINGERPRINT: Final[bytes] = rtc3d.tool_pose_t._get_packed_fingerprint()  # noqa: SLF001 - lcm-gen offers no other way
# Frame number, time stamp, visible, position, orientation, error.
_CONTENT: Final = struct.Struct(">iq?8f")
_NO_POSE: Final = (math.nan,) * 8
_UNITS: Final = {
    1.0: "m metre metres meter meters",
    1e-1: "dm decimetre decimetres decimeter decimeters",
    1e-2: "cm centimetre centimetres centimeter centimeters",
    1e-3: "mm millimetre millimetres millimeter millimeters",
    1e-6: "um µm microm micron microns micrometre micrometres micrometer micrometers",
    0.0254: "in inch inches",
    0.3048: "ft foot feet",
}
_METRES: Final = {name.casefold(): metres for metres, names in _UNITS.items() for name in names.split()}


def metres_per_unit(unit: str) -> float | None:
    """Return the length in metres of ``unit`` in the 3D parameters (§6.2); None if it is unknown."""
    return _METRES.get(unit.strip().casefold() or "mm")


def tool_poses(
    component: Component, stamp: Stamp, sequences: Sequence[int], frame: CoordinateFrame
) -> list[bytes]:
    """Return one ``tool_pose_t`` message per tool of a 6D component, with poses in ``frame``.

    Positions and errors are in metres; quaternions have the order x, y, z, w. ``sequences`` has one sequence
    number per tool. The unit of ``frame`` must be known.
    """
    head = (component.frame_number, component.timestamp_us)
    return [
        _FINGERPRINT
        + stamp.prefix(sequence)
        + (_CONTENT.pack(*head, False, *_NO_POSE) if pose is None else _CONTENT.pack(*head, True, *pose))
        for pose, sequence in zip(frame.poses(component.items(), accept_zeros=True), sequences, strict=True)
    ]


def split_rows(table: npt.NDArray[np.uint8]) -> list[bytes]:
    """Return each row of a table of bytes, shape (rows, bytes)."""
    content, size = table.tobytes(), table.shape[1]
    return [content[start : start + size] for start in range(0, len(content), size)]
