"""Data frames and their five components (§7): split, check, view as numpy arrays, build."""

import struct
from collections.abc import Iterable
from enum import IntEnum
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gateway.errors import FrameError

ByteOrder = Literal["big", "little"]
Items = npt.NDArray[Any]


class ComponentType(IntEnum):
    """The component types of §7.2. ``key`` is the name used in keys, channels and configuration."""

    MARKERS = 1
    ANALOG = 2
    FORCE = 3
    TOOLS = 4
    EVENT = 5

    @property
    def key(self) -> str:
        """3d, analog, force, 6d or event."""
        return _KEYS[self]


_KEYS: Final = {
    ComponentType.MARKERS: "3d",
    ComponentType.ANALOG: "analog",
    ComponentType.FORCE: "force",
    ComponentType.TOOLS: "6d",
    ComponentType.EVENT: "event",
}
BY_KEY: Final = {key: component for component, key in _KEYS.items()}

WIRE_ORDER: Final = (
    ComponentType.MARKERS,
    ComponentType.TOOLS,
    ComponentType.ANALOG,
    ComponentType.FORCE,
    ComponentType.EVENT,
)
"""The order in which servers put components into a frame (field note 5)."""

MISSING: Final = np.uint32(0xFFFFFFFF).view(np.float32)
"""A float of a missing marker or tool: all 32 bits set, a negative quiet NaN (§7.3, field note 7)."""

MISSING_RELIABILITY: Final = 999.0
"""The Reliability of a missing marker (field note 7)."""


def _floats(*names: str) -> np.dtype[Any]:
    return np.dtype([(name, ">f4") for name in names])


SHORT_EVENT: Final = np.dtype([("id", ">i4"), ("param1", ">i4"), ("param2", ">i4"), ("param3", ">i4")])
"""An event as §7.7 has it: 16 bytes."""

LONG_EVENT: Final = np.dtype(
    [("id", ">i4"), ("timestamp", ">i8"), ("param1", ">i4"), ("param2", ">i4"), ("param3", ">i4")]
)
"""An event as NDI's own code writes it: 24 bytes, with a time stamp in µs (field note 6)."""

ITEM_DTYPES: Final[dict[ComponentType, np.dtype[Any]]] = {
    ComponentType.MARKERS: _floats("x", "y", "z", "reliability"),
    ComponentType.ANALOG: np.dtype(">f4"),
    ComponentType.FORCE: _floats("fx", "fy", "fz", "mx", "my", "mz"),
    ComponentType.TOOLS: _floats("q0", "qx", "qy", "qz", "x", "y", "z", "error"),
    ComponentType.EVENT: LONG_EVENT,
}
"""One item of each component in big-endian form (§7.3 to §7.7), 4-byte packing (§3.2)."""

# §7.1 header of a known component with the count that begins its data:
# size, type, frame number, time stamp in µs, count.
_KNOWN: Final = {"big": struct.Struct(">IIiqI"), "little": struct.Struct("<IIiqI")}
_SIZE_AND_TYPE: Final = {"big": struct.Struct(">II"), "little": struct.Struct("<II")}
_COUNT: Final = {"big": struct.Struct(">I"), "little": struct.Struct("<I")}
_HEADER_BYTES: Final = 24
_CONTENT_HEADER_BYTES: Final = 16  # of Component.content: frame number, time stamp, count


class Component(NamedTuple):
    """One component of a frame.

    ``timestamp_us`` is µs from the server's start. ``content`` is the component after its size and
    type fields (frame number, time stamp, count, items), in ``byte_order``, a view of the packet.
    ``item_bytes`` is 16 or 24 for events and the item's own size for the others.
    """

    type: ComponentType
    frame_number: int
    timestamp_us: int
    num_items: int
    item_bytes: int
    byte_order: ByteOrder
    content: bytes | memoryview

    def items(self) -> Items:
        """Return the items, shape (num_items,), as a read-only view of the packet in its own byte order.

        The dtype has the fields of ITEM_DTYPES (SHORT_EVENT for events of 16 bytes).
        """
        dtype = SHORT_EVENT if self.item_bytes == 16 and self.type is ComponentType.EVENT else None
        if dtype is None:
            dtype = ITEM_DTYPES[self.type]
        return np.frombuffer(
            self.content,
            dtype.newbyteorder(self.byte_order),
            self.num_items,
            _CONTENT_HEADER_BYTES,
        )


class Frame(NamedTuple):
    """A data frame: its known components as they came, and the types of those skipped as unknown."""

    components: tuple[Component, ...]
    unknown_types: tuple[int, ...]


_ITEM_BYTES: Final = {int(component): (component, dtype.itemsize) for component, dtype in ITEM_DTYPES.items()}


def split_frame(body: bytes, byte_order: ByteOrder) -> Frame:
    """Split a type-3 packet's body into components without copying (§7.1).

    Components of unknown type are skipped by their size. Raises FrameError where a size or count
    contradicts another or the body's length; nothing of such a frame can be trusted.
    """
    total = len(body)
    if total < 4:
        raise FrameError(f"data frame of {total} bytes: too short for its component count")
    (component_count,) = _COUNT[byte_order].unpack_from(body)
    unpack_known = _KNOWN[byte_order].unpack_from
    view = memoryview(body)
    components: list[Component] = []
    unknown: list[int] = []
    start = 4
    for index in range(component_count):
        if total - start >= _HEADER_BYTES:
            size, kind, frame_number, timestamp_us, count = unpack_known(body, start)
        elif total - start >= 8:
            size, kind = _SIZE_AND_TYPE[byte_order].unpack_from(body, start)
            frame_number = timestamp_us = count = 0
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
        known = _ITEM_BYTES.get(kind)
        if known is None:
            unknown.append(kind)
        else:
            component, item_bytes = known
            if size != _HEADER_BYTES + count * item_bytes:
                item_bytes = _other_item_bytes(component, size, count)
            components.append(
                Component(
                    component,
                    frame_number,
                    timestamp_us,
                    count,
                    item_bytes,
                    byte_order,
                    view[start + 8 : end],
                )
            )
        start = end
    if start != total:
        raise FrameError(f"{total - start} bytes follow the last of the frame's {component_count} components")
    return Frame(tuple(components), tuple(unknown))


def _other_item_bytes(component: ComponentType, size: int, count: int) -> int:
    """Return 16 for events in the specification's form (field note 6); else raise FrameError."""
    if component is ComponentType.EVENT and size == _HEADER_BYTES + count * SHORT_EVENT.itemsize:
        return SHORT_EVENT.itemsize
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


def big_endian_content(component: Component) -> bytes | memoryview:
    """Return ``component.content`` in big-endian form, events in their own item size."""
    if component.byte_order == "big":
        return component.content
    header = struct.pack(">iqI", component.frame_number, component.timestamp_us, component.num_items)
    items = component.items()
    return header + items.astype(items.dtype.newbyteorder(">")).tobytes()


def build_component(
    component: ComponentType,
    frame_number: int,
    timestamp_us: int,
    items: Items,
    byte_order: ByteOrder = "big",
) -> bytes:
    """Return one component's bytes (§7.1 to §7.7) from ``items``, shape (count,).

    ``items`` has the dtype of ITEM_DTYPES in any byte order; events may be SHORT_EVENT instead.
    """
    wire = items.astype(items.dtype.newbyteorder(byte_order), copy=False)
    data = wire.tobytes()
    size = _HEADER_BYTES + len(data)
    return _KNOWN[byte_order].pack(size, component, frame_number, timestamp_us, len(items)) + data


def build_frame(components: Iterable[bytes], byte_order: ByteOrder = "big") -> bytes:
    """Return a type-3 packet's body from components that ``build_component`` made."""
    parts = list(components)
    return _COUNT[byte_order].pack(len(parts)) + b"".join(parts)
