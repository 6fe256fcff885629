"""Data frames (§7.1): split into components, and built from them."""

import struct
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Final, NamedTuple

from gateway.errors import FrameError
from gateway.rtc3d.components import (
    HEADER_BYTES,
    ITEM_DTYPES,
    KNOWN_HEADER,
    NUMBER_AND_TIME,
    SHORT_EVENT,
    ByteOrder,
    Component,
    ComponentType,
)

_SIZE_AND_TYPE: Final = {"big": struct.Struct(">II"), "little": struct.Struct("<II")}
_COUNT: Final = {"big": struct.Struct(">I"), "little": struct.Struct("<I")}
_ITEM_BYTES: Final = {int(component): (component, dtype.itemsize) for component, dtype in ITEM_DTYPES.items()}


class ComponentLayout(NamedTuple):
    """What a layout says of a known component; ``item_bytes`` is 16 or 24 for events, else the item's own."""

    type: ComponentType
    num_items: int
    item_bytes: int


class _Header(NamedTuple):
    """What stays of a component's header; ``part`` is None where the type is unknown."""

    size: int
    type: int
    part: ComponentLayout | None


class Layout:
    """All that frames laid out alike have in common; ``layout_of`` gives the same object for the same layout.

    ``parts`` are the known components in their order, ``unknown_types`` the types of those skipped.
    """

    def __init__(self, byte_order: ByteOrder, headers: tuple[_Header, ...]) -> None:
        self.byte_order: ByteOrder = byte_order
        self.parts = tuple(header.part for header in headers if header.part is not None)
        self.first_type = self.parts[0].type if self.parts else None
        """Of the first known component; None in a frame without any."""
        self.unknown_types = tuple(header.type for header in headers if header.part is None)
        self.number_and_time = NUMBER_AND_TIME[byte_order].unpack_from
        """Called with a component's content: its frame number and time stamp in µs."""
        self.headers = headers
        """What stays of every component's header, those of unknown type included."""
        self.spans = tuple(_spans(headers))
        """Where in the body each known component's content begins and ends."""


def _spans(headers: tuple[_Header, ...]) -> Iterator[tuple[int, int]]:
    start = 4
    for size, _, part in headers:
        if part is not None:
            yield start + 8, start + size
        start += size


layout_of = lru_cache(256)(Layout)


class Frame:
    """A data frame: its layout, and the packet's ``body``, from which contents are cut when asked for.

    A component's content is what follows its size and type: frame number, time stamp, count and items,
    in the layout's byte order.
    """

    __slots__ = ("body", "layout")

    def __init__(self, layout: Layout, body: bytes) -> None:
        self.layout = layout
        self.body = body

    def content(self, index: int) -> bytes:
        """Return the content of the known component at ``index``."""
        start, end = self.layout.spans[index]
        return self.body[start:end]

    @property
    def contents(self) -> tuple[bytes, ...]:
        """The contents of the known components."""
        return tuple(self.content(index) for index in range(len(self.layout.parts)))

    @property
    def number_and_time(self) -> tuple[int, int]:
        """Frame number and time stamp in µs of the first known component; there must be one."""
        layout = self.layout
        return layout.number_and_time(self.body, layout.spans[0][0])

    @property
    def components(self) -> tuple[Component, ...]:
        """The known components, as they came."""
        return tuple(self.component(index) for index in range(len(self.layout.parts)))

    def component(self, index: int) -> Component:
        """Return the known component at ``index``."""
        layout = self.layout
        part, content = layout.parts[index], self.content(index)
        frame_number, timestamp_us = layout.number_and_time(content, 0)
        return Component(
            part.type,
            frame_number,
            timestamp_us,
            part.num_items,
            part.item_bytes,
            layout.byte_order,
            content,
        )

    @property
    def unknown_types(self) -> tuple[int, ...]:
        """The types of the components that were skipped as unknown."""
        return self.layout.unknown_types


def split_frame(body: bytes, byte_order: ByteOrder) -> Frame:
    """Split a type-3 packet's body into components (§7.1).

    Components of unknown type are skipped by their size. Raises FrameError where a size or count
    contradicts another or the body's length; nothing of such a frame can be trusted.
    """
    total = len(body)
    if total < 4:
        raise FrameError(f"data frame of {total} bytes: too short for its component count")
    (component_count,) = _COUNT[byte_order].unpack_from(body)
    headers: list[_Header] = []
    start = 4
    for index in range(component_count):
        if total - start >= HEADER_BYTES:
            size, kind, _, _, count = KNOWN_HEADER[byte_order].unpack_from(body, start)
        elif total - start >= 8:
            size, kind = _SIZE_AND_TYPE[byte_order].unpack_from(body, start)
            count = 0
        else:
            raise FrameError(
                f"data frame announces {component_count} components; its {total} bytes end after {index}"
            )
        end = start + size
        if size < 8 or end > total:
            raise FrameError(
                f"component {index + 1} of {component_count} (type {kind}) has size {size}; "
                f"{total - start} bytes are left in the frame"
            )
        headers.append(_Header(size, kind, _part(kind, size, count)))
        start = end
    if start != total:
        raise FrameError(f"{total - start} bytes follow the last of the frame's {component_count} components")
    return Frame(layout_of(byte_order, tuple(headers)), body)


def _part(kind: int, size: int, count: int) -> ComponentLayout | None:
    """Return what the component is; None for an unknown type. Raises FrameError if size and count differ."""
    known = _ITEM_BYTES.get(kind)
    if known is None:
        return None
    component, item_bytes = known
    if size == HEADER_BYTES + count * item_bytes:
        return ComponentLayout(component, count, item_bytes)
    # Events in the specification's form (field note 6).
    if component is ComponentType.EVENT and size == HEADER_BYTES + count * SHORT_EVENT.itemsize:
        return ComponentLayout(component, count, SHORT_EVENT.itemsize)
    raise FrameError(f"{component.key} component of {size} bytes announces {count} items")


def byte_order_of(body: bytes, expected: ByteOrder) -> ByteOrder:
    """Return the byte order in which the frame makes sense, ``expected`` if it does in both.

    Some servers acknowledge a byte order and then ignore it (field note 4). Raises FrameError, the
    one for ``expected``, if the frame makes sense in neither.
    """
    other: ByteOrder = "little" if expected == "big" else "big"
    try:
        split_frame(body, expected)
    except FrameError as error:
        try:
            split_frame(body, other)
        except FrameError:
            raise error from None
        return other
    return expected


def build_frame(components: Iterable[bytes], byte_order: ByteOrder = "big") -> bytes:
    """Return a type-3 packet's body from components that ``build_component`` made."""
    parts = list(components)
    return _COUNT[byte_order].pack(len(parts)) + b"".join(parts)
