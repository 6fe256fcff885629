"""Faults of data frames (§7): wrong values, time stamps, layouts and sizes."""

# ruff: noqa: ARG002 - hooks: not every kind needs every argument

import struct
from collections.abc import Callable
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from gateway.config.section import expects
from gateway.errors import FrameError
from gateway.rtc3d.components import (
    MISSING,
    MISSING_MARKER,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
    Items,
    encode_component,
)
from gateway.rtc3d.frames import detect_byte_order, encode_frame, split_frame
from gateway.rtc3d.packets import PACKET_HEADER, PacketType, encode_packet
from gateway.simulator.faults.base import ActiveFault, LastingConnectionFault, PendingWrite, packet_type_of

Fraction = Annotated[
    float, Field(strict=True, ge=0, le=1, allow_inf_nan=False), expects("a number from 0 to 1")
]
Jump = Annotated[
    float,
    Field(strict=True, ge=-1e12, le=1e12, allow_inf_nan=False),
    expects("a number of milliseconds from -1e12 to 1e12"),
]
FrameNumber = Annotated[
    int, Field(strict=True, ge=-(2**31), lt=2**31), expects("a signed 32-bit whole number")
]
UnknownType = Annotated[
    int, Field(strict=True, ge=6, le=0xFFFFFFFF), expects("a whole number from 6 to 4294967295")
]
DataBytes = Annotated[int, Field(strict=True, ge=0, le=65536), expects("a whole number from 0 to 65536")]

_COUNT: Final[dict[ByteOrder, struct.Struct]] = {"big": struct.Struct(">I"), "little": struct.Struct("<I")}
_HEADER: Final[dict[ByteOrder, struct.Struct]] = {
    "big": struct.Struct(">IIiq"),
    "little": struct.Struct("<IIiq"),
}
_WRONG_BY: Final = 1000
_OFFSETS: Final = {"components": 0, "size": 4, "items": 24}
"""Offsets in a frame's body: of the number of components, and of the first one's size and number of items."""


class FrameFault(LastingConnectionFault):
    """A fault of data frames. It leaves other packets, and frames damaged by another fault, unchanged."""

    def change_writes(self, writes: list[PendingWrite], active: ActiveFault) -> list[PendingWrite]:
        """See LastingConnectionFault."""
        return [write._replace(data=self._change_packet(write.data, active)) for write in writes]

    def _change_packet(self, packet: bytes, active: ActiveFault) -> bytes:
        if packet_type_of(packet) != PacketType.DATA:
            return packet
        body = packet[PACKET_HEADER.size :]
        try:
            byte_order = detect_byte_order(body, "big")
        except FrameError:
            return packet
        return encode_packet(PacketType.DATA, self.change_frame(body, byte_order, active))

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """Return the body to send instead of ``body``."""
        raise NotImplementedError


class Occlusion(FrameFault):
    """Markers and tools are out of view."""

    kind: ClassVar[str] = "occlusion"

    markers: Fraction = 1.0
    """The fraction of the markers that is out of view; other markers each time the fault begins."""

    tools: Fraction = 1.0
    """The fraction of the tools that is out of view."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""

        def hide(component: Component) -> bytes:
            items = component.items().copy()
            if component.type is ComponentType.MARKERS:
                hidden = _choose(self.markers, len(items), active.variant)
                items[hidden] = MISSING_MARKER
            elif component.type is ComponentType.TOOLS:
                items[_choose(self.tools, len(items), active.variant)] = (MISSING,) * 8
            return _rebuild(component, items=items)

        return _change_components(body, byte_order, hide)


class FrozenTimestamps(FrameFault):
    """Time stamps keep the value that they have when the fault begins."""

    kind: ClassVar[str] = "frozen_timestamps"

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        if active.timestamp_us is None:
            components = split_frame(body, byte_order).components
            active.timestamp_us = components[0].timestamp_us if components else None
        return _change_components(
            body, byte_order, lambda component: _rebuild(component, timestamp_us=active.timestamp_us)
        )


class JumpingTimestamps(FrameFault):
    """Time stamps jump, and jump back when the fault ends."""

    kind: ClassVar[str] = "jumping_timestamps"

    jump_ms: Jump = -5000.0
    """The jump in milliseconds; a negative value jumps into the past."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        jump_us = round(self.jump_ms * 1000)
        return _change_components(
            body,
            byte_order,
            lambda component: _rebuild(component, timestamp_us=component.timestamp_us + jump_us),
        )


class ConstantFrameNumbers(FrameFault):
    """Every frame has the same number.

    Field note 11.
    """

    kind: ClassVar[str] = "constant_frame_numbers"

    frame_number: FrameNumber = 0
    """The frame number."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        return _change_components(
            body, byte_order, lambda component: _rebuild(component, frame_number=self.frame_number)
        )


class ShortEvents(FrameFault):
    """Events have 16 bytes as in §7.7, instead of NDI's 24.

    Field note 6.
    """

    kind: ClassVar[str] = "short_events"

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""

        def shorten(component: Component) -> bytes:
            items = component.items()
            if component.type is ComponentType.EVENT:
                items = items[list(SHORT_EVENT.names or ())].astype(SHORT_EVENT)
            return _rebuild(component, items=items)

        return _change_components(body, byte_order, shorten)


class WrongByteOrder(FrameFault):
    """Frames have a different byte order than the server acknowledged.

    Field note 4.
    """

    kind: ClassVar[str] = "wrong_byte_order"

    byte_order: Annotated[Literal["big", "little", "other"], expects("big, little or other")] = "other"
    """big or little: always this byte order; other: the one that the client did not request."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        if self.byte_order != "other":
            order: ByteOrder = self.byte_order
        else:
            order = "little" if byte_order == "big" else "big"
        return _change_components(
            body, byte_order, lambda component: _rebuild(component, byte_order=order), order
        )


class UnknownComponent(FrameFault):
    """Frames have an additional component of a type that §7.2 does not define."""

    kind: ClassVar[str] = "unknown_component"

    component_type: UnknownType = 77
    """The type of the component."""

    data_bytes: DataBytes = 32
    """The size of its data in bytes, all zeros."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        (count,) = _COUNT[byte_order].unpack_from(body)
        header = _HEADER[byte_order]
        component = header.pack(header.size + self.data_bytes, self.component_type, 0, 0)
        return _COUNT[byte_order].pack(count + 1) + body[4:] + component + bytes(self.data_bytes)


class WrongCounts(FrameFault):
    """The sizes and counts in a frame contradict each other."""

    kind: ClassVar[str] = "wrong_counts"

    field: Annotated[Literal["components", "size", "items"], expects("components, size or items")] = "items"
    """The field that is 1000 too large: the number of components, or the first component's size or items."""

    def change_frame(self, body: bytes, byte_order: ByteOrder, active: ActiveFault) -> bytes:
        """See FrameFault."""
        damaged = bytearray(body)
        (count,) = _COUNT[byte_order].unpack_from(damaged, _OFFSETS[self.field])
        _COUNT[byte_order].pack_into(damaged, _OFFSETS[self.field], (count + _WRONG_BY) % 2**32)
        return bytes(damaged)


FRAME_FAULTS: Final[tuple[type[FrameFault], ...]] = (
    Occlusion,
    FrozenTimestamps,
    JumpingTimestamps,
    ConstantFrameNumbers,
    ShortEvents,
    WrongByteOrder,
    UnknownComponent,
    WrongCounts,
)


def _change_components(
    body: bytes,
    byte_order: ByteOrder,
    change: Callable[[Component], bytes],
    new_byte_order: ByteOrder | None = None,
) -> bytes:
    """Return a frame's body with every component changed."""
    components = split_frame(body, byte_order).components
    return encode_frame([change(component) for component in components], new_byte_order or byte_order)


def _rebuild(
    component: Component,
    *,
    frame_number: int | None = None,
    timestamp_us: int | None = None,
    items: Items | None = None,
    byte_order: ByteOrder | None = None,
) -> bytes:
    """Return a component's bytes, with the given values instead of its own."""
    return encode_component(
        component.type,
        component.frame_number if frame_number is None else frame_number,
        component.timestamp_us if timestamp_us is None else timestamp_us,
        component.items() if items is None else items,
        byte_order or component.byte_order,
    )


def _choose(fraction: float, count: int, variant: int) -> Items:
    """Return the indices of a fraction of the items, shape (⌈fraction · count⌉,); ``variant`` is the seed."""
    order = np.random.default_rng(variant).permutation(count)
    return order[: int(np.ceil(fraction * count))]
