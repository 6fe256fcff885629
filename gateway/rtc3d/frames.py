"""Data frames (§7.1): split into components, recognised by how the ones before were laid out, built.

Frame after frame of a stream has the same components with as many items, so nothing but numbers, times
and items differs. ``split_frame`` reads a frame field by field; a template of the ``Layout`` that it finds
recognises the next ones by comparing all that stays in one go. Contents are cut out when they are asked for.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import Any, Final, NamedTuple

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
from gateway.rtc3d.packets import HEADER, PacketType

_SIZE_AND_TYPE: Final = {"big": struct.Struct(">II"), "little": struct.Struct("<II")}
_COUNT: Final = {"big": struct.Struct(">I"), "little": struct.Struct("<I")}
_ITEM_BYTES: Final = {int(component): (component, dtype.itemsize) for component, dtype in ITEM_DTYPES.items()}
_Unpack = Callable[[bytes, int], tuple[Any, ...]]

_KEY_BYTES: Final = 12  # a packet's size and type, and the frame's component count
_MAX_LAYOUTS: Final = 32


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

    ``parts`` are the known components in their order, ``unknown_types`` the types of those skipped, and
    ``packet_bytes`` is the size of the whole packet.
    """

    def __init__(self, byte_order: ByteOrder, headers: tuple[_Header, ...]) -> None:
        self.byte_order: ByteOrder = byte_order
        self.parts = tuple(header.part for header in headers if header.part is not None)
        self.first_type = self.parts[0].type if self.parts else None
        """Of the first known component; None in a frame without any."""
        self.unknown_types = tuple(header.type for header in headers if header.part is None)
        self.packet_bytes = _KEY_BYTES + sum(header.size for header in headers)
        self.number_and_time = NUMBER_AND_TIME[byte_order].unpack_from
        """Called with a component's content: its frame number and time stamp in µs."""
        self.key = HEADER.pack(self.packet_bytes, PacketType.DATA) + _COUNT[byte_order].pack(len(headers))
        """The first 12 bytes of the packets: size, type, component count."""
        self.headers = headers
        """What stays of every component's header, those of unknown type included."""
        self.spans = tuple(_spans(headers))
        """Where in the packet each known component's content begins and ends."""


def _spans(headers: tuple[_Header, ...]) -> Iterator[tuple[int, int]]:
    start = _KEY_BYTES
    for size, _, part in headers:
        if part is not None:
            yield start + 8, start + size
        start += size


layout_of = lru_cache(256)(Layout)


class Frame:
    """A data frame: its layout, and ``data`` with its packet at ``start``, which is cut when asked for.

    What a known component holds after size and type is its content: frame number, time stamp, count
    and items, in the layout's byte order. ``data`` may hold more; it is kept as long as the frame is.
    """

    __slots__ = ("_data", "_start", "layout")

    def __init__(self, layout: Layout, data: bytes, start: int) -> None:
        self.layout = layout
        self._data = data
        self._start = start

    def content(self, index: int) -> bytes:
        """Return the content of the known component at ``index``."""
        first, end = self.layout.spans[index]
        start = self._start
        return self._data[start + first : start + end]

    @property
    def contents(self) -> tuple[bytes, ...]:
        """The contents of the known components."""
        return tuple(self.content(index) for index in range(len(self.layout.parts)))

    @property
    def number_and_time(self) -> tuple[int, int]:
        """Frame number and time stamp in µs of the first known component; there must be one."""
        layout = self.layout
        return layout.number_and_time(self._data, self._start + layout.spans[0][0])

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


class _Template:
    """Recognises the packets of one layout."""

    def __init__(self, layout: Layout) -> None:
        order = ">" if layout.byte_order == "big" else "<"
        constants_at = f"{order}QI"
        example = layout.key
        for size, kind, part in layout.headers:
            if part is None:
                constants_at += f"Q{size - 8}x"
                example += struct.pack(f"{order}II{size - 8}x", size, kind)
            else:
                constants_at += f"Q12xI{size - HEADER_BYTES}x"
                example += struct.pack(f"{order}II12xI{size - HEADER_BYTES}x", size, kind, part.num_items)
        self.layout = layout
        self.packet_bytes = layout.packet_bytes
        self._constants_at: _Unpack = struct.Struct(constants_at).unpack_from
        self._constants = self._constants_at(example, 0)
        """What is the same in every packet of this layout: key, sizes with types, counts."""

    def find(self, data: bytes, start: int) -> Frame | None:
        """Return the frame in the packet at ``start``; None if it is laid out otherwise.

        The packet's ``packet_bytes`` must be there. One call of struct does it: a dense frame takes 0.3 µs,
        ``split_frame`` 4 µs.
        """
        if self._constants_at(data, start) != self._constants:
            return None
        return Frame(self.layout, data, start)


class KnownLayouts:
    """The layouts of a connection's frames so far, at most 32: with no, one or two events, for example."""

    def __init__(self) -> None:
        self._by_key: dict[bytes, _Template] = {}
        self._newest: _Template | None = None

    @property
    def newest_bytes(self) -> int:
        """The size of the packets laid out like the newest; 0 before the first."""
        return 0 if self._newest is None else self._newest.packet_bytes

    def learn(self, layout: Layout) -> None:
        """Keep a layout; when there are too many all others are forgotten."""
        template = self._by_key.get(layout.key)
        if template is None or template.layout is not layout:
            if len(self._by_key) >= _MAX_LAYOUTS:
                self._by_key.clear()
            template = self._by_key[layout.key] = _Template(layout)
        self._newest = template

    def cut(self, data: bytes, start: int, frames: list[Any]) -> int:
        """Append the frames that are in the packets from ``start`` on and return where these end.

        That is at the first packet which is unfinished, no frame, or laid out as none before.
        """
        total = len(data)
        template = self._newest
        while template is not None and total - start >= template.packet_bytes:
            frame = template.find(data, start)
            if frame is not None:
                frames.append(frame)
                start += template.packet_bytes
            else:
                known = self._by_key.get(data[start : start + _KEY_BYTES])
                if known is template:  # looked alike, and is not
                    break
                template = known
        return start


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
    return Frame(layout_of(byte_order, tuple(headers)), body, -HEADER.size)


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
