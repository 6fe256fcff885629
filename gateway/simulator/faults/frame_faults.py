"""Faults of data frames (§7): values, time stamps, forms and sizes that are not as they should be."""

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
    MISSING_RELIABILITY,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
    Items,
    build_component,
)
from gateway.rtc3d.frames import build_frame, byte_order_of, split_frame
from gateway.rtc3d.packets import HEADER, PacketType, encode_packet
from gateway.simulator.faults.base import Chunk, LineFault, Run, type_of

Share = Annotated[float, Field(strict=True, ge=0, le=1, allow_inf_nan=False), expects("a share from 0 to 1")]
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
_OFFSETS: Final = {"components": 0, "size": 4, "items": 24}  # in a frame, of its and its first component's


class FrameFault(LineFault):
    """A fault of data frames; other packets, and frames that another fault spoilt, pass as they are."""

    def outgoing(self, chunks: list[Chunk], run: Run) -> list[Chunk]:
        """See LineFault."""
        return [chunk._replace(data=self._changed(chunk.data, run)) for chunk in chunks]

    def _changed(self, packet: bytes, run: Run) -> bytes:
        if type_of(packet) != PacketType.DATA:
            return packet
        body = packet[HEADER.size :]
        try:
            byte_order = byte_order_of(body, "big")
        except FrameError:
            return packet
        return encode_packet(PacketType.DATA, self.frame(body, byte_order, run))

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """Return what is to be sent instead of a frame's body."""
        raise NotImplementedError


class Occlusion(FrameFault):
    """Markers and tools are out of view."""

    kind: ClassVar[str] = "occlusion"

    markers: Share = 1.0
    """Which share of the markers, others each time it begins."""

    tools: Share = 1.0
    """Which share of the tools."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""

        def hide(component: Component) -> bytes:
            items = component.items().copy()
            if component.type is ComponentType.MARKERS:
                hidden = _chosen(self.markers, len(items), run.variant)
                items[hidden] = (MISSING, MISSING, MISSING, MISSING_RELIABILITY)
            elif component.type is ComponentType.TOOLS:
                items[_chosen(self.tools, len(items), run.variant)] = (MISSING,) * 8
            return _rebuilt(component, items=items)

        return _each(body, byte_order, hide)


class FrozenTimestamps(FrameFault):
    """Time stamps stand still at when it began."""

    kind: ClassVar[str] = "frozen_timestamps"

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        return _each(body, byte_order, lambda component: _rebuilt(component, timestamp_us=run.began_us))


class JumpingTimestamps(FrameFault):
    """Time stamps jump, and jump back at the end."""

    kind: ClassVar[str] = "jumping_timestamps"

    jump_ms: Jump = -5000.0
    """How far, in ms; below 0 into the past."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        jump_us = round(self.jump_ms * 1000)
        return _each(
            body,
            byte_order,
            lambda component: _rebuilt(component, timestamp_us=component.timestamp_us + jump_us),
        )


class ConstantFrameNumbers(FrameFault):
    """Every frame has the same number.

    Field note 11.
    """

    kind: ClassVar[str] = "constant_frame_numbers"

    frame_number: FrameNumber = 0
    """Which."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        return _each(body, byte_order, lambda part: _rebuilt(part, frame_number=self.frame_number))


class ShortEvents(FrameFault):
    """Events are of 16 bytes, as §7.7 has them, instead of NDI's 24.

    Field note 6.
    """

    kind: ClassVar[str] = "short_events"

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""

        def shorten(component: Component) -> bytes:
            items = component.items()
            if component.type is ComponentType.EVENT:
                items = items[list(SHORT_EVENT.names or ())].astype(SHORT_EVENT)
            return _rebuilt(component, items=items)

        return _each(body, byte_order, shorten)


class WrongByteOrder(FrameFault):
    """Frames are in another byte order than was acknowledged.

    Field note 4.
    """

    kind: ClassVar[str] = "wrong_byte_order"

    byte_order: Annotated[Literal["big", "little", "other"], expects("big, little or other")] = "other"
    """big or little, whatever the client asks for; other than it asked for."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        if self.byte_order != "other":
            order: ByteOrder = self.byte_order
        else:
            order = "little" if byte_order == "big" else "big"
        return _each(body, byte_order, lambda part: _rebuilt(part, byte_order=order), order)


class UnknownComponent(FrameFault):
    """Frames have one more component, of a type that §7.2 does not know."""

    kind: ClassVar[str] = "unknown_component"

    component_type: UnknownType = 77
    """Its type."""

    data_bytes: DataBytes = 32
    """How much data it has, all zeros."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        (count,) = _COUNT[byte_order].unpack_from(body)
        header = _HEADER[byte_order]
        component = header.pack(header.size + self.data_bytes, self.component_type, 0, 0)
        return _COUNT[byte_order].pack(count + 1) + body[4:] + component + bytes(self.data_bytes)


class WrongCounts(FrameFault):
    """A frame's sizes and counts contradict each other."""

    kind: ClassVar[str] = "wrong_counts"

    field: Annotated[Literal["components", "size", "items"], expects("components, size or items")] = "items"
    """Which is too large: the number of components, or the first component's size or number of items."""

    def frame(self, body: bytes, byte_order: ByteOrder, run: Run) -> bytes:
        """See FrameFault."""
        spoilt = bytearray(body)
        (count,) = _COUNT[byte_order].unpack_from(spoilt, _OFFSETS[self.field])
        _COUNT[byte_order].pack_into(spoilt, _OFFSETS[self.field], (count + _WRONG_BY) % 2**32)
        return bytes(spoilt)


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


def _each(
    body: bytes,
    byte_order: ByteOrder,
    change: Callable[[Component], bytes],
    new_order: ByteOrder | None = None,
) -> bytes:
    components = split_frame(body, byte_order).components
    return build_frame([change(component) for component in components], new_order or byte_order)


def _rebuilt(
    component: Component,
    *,
    frame_number: int | None = None,
    timestamp_us: int | None = None,
    items: Items | None = None,
    byte_order: ByteOrder | None = None,
) -> bytes:
    return build_component(
        component.type,
        component.frame_number if frame_number is None else frame_number,
        component.timestamp_us if timestamp_us is None else timestamp_us,
        component.items() if items is None else items,
        byte_order or component.byte_order,
    )


def _chosen(share: float, count: int, variant: int) -> Items:
    """Return which of ``count`` items are meant, shape (⌈share · count⌉,), the same for one variant."""
    order = np.random.default_rng(variant).permutation(count)
    return order[: int(np.ceil(share * count))]
