"""The five components of data frames (§7.3 to §7.7): names, items as numpy arrays, encoding."""

import struct
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.component_types import COMPONENTS_BY_KEY, WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import SECTIONS, Parameters, Parameters3D, only_sections

__all__ = ["COMPONENTS_BY_KEY", "WIRE_ORDER", "ComponentType"]  # those of component_types

ByteOrder = Literal["big", "little"]
Items: TypeAlias = npt.NDArray[Any]

MISSING: Final = np.uint32(0xFFFFFFFF).view(np.float32)
"""All fields of a missing tool, and x, y, z of a missing marker: 32 bits set, a NaN (§7.3, field note 7)."""

MISSING_RELIABILITY: Final = 999.0
"""The Reliability of a missing marker (field note 7)."""

MISSING_MARKER: Final = (MISSING, MISSING, MISSING, MISSING_RELIABILITY)
"""The values of a missing marker."""

POSE_FIELDS: Final = ("q0", "qx", "qy", "qz", "x", "y", "z")
"""The fields of markers and tools that are finite numbers if one is visible."""


def is_visible(items: Items) -> Items:
    """Return for each marker or tool whether it is visible, bool, in the shape of ``items``.

    One with a NaN in its position or its orientation is missing (§7.3, field note 7); so is an infinite one,
    which no display can show. Reliability and error do not count.
    """
    visible = np.ones(items.shape, np.bool_)
    for name in POSE_FIELDS:
        if name in (items.dtype.names or ()):
            visible &= np.isfinite(items[name])
    return visible


def _floats(*names: str) -> np.dtype[Any]:
    return np.dtype([(name, ">f4") for name in names])


SHORT_EVENT: Final = np.dtype([("id", ">i4"), ("param1", ">i4"), ("param2", ">i4"), ("param3", ">i4")])
"""An event as §7.7 specifies it: 16 bytes."""

LONG_EVENT: Final = np.dtype(
    [("id", ">i4"), ("timestamp", ">i8"), ("param1", ">i4"), ("param2", ">i4"), ("param3", ">i4")]
)
"""An event as NDI's own code writes it: 24 bytes, with a time stamp in µs per event (field note 6)."""

ITEM_DTYPES: Final[dict[ComponentType, np.dtype[Any]]] = {
    ComponentType.MARKERS: _floats("x", "y", "z", "reliability"),
    ComponentType.ANALOG: np.dtype(">f4"),
    ComponentType.FORCE: _floats("fx", "fy", "fz", "mx", "my", "mz"),
    ComponentType.TOOLS: _floats("q0", "qx", "qy", "qz", "x", "y", "z", "error"),
    ComponentType.EVENT: LONG_EVENT,
}
"""The dtype of one item of each component: big-endian (§7.3 to §7.7), 4-byte packing (§3.2)."""

COMPONENT_HEADER: Final = {"big": struct.Struct(">IIiqI"), "little": struct.Struct("<IIiqI")}
"""The fields before a component's items (§7.1): size, type, frame number, time stamp in µs, item count."""
COMPONENT_HEADER_BYTES: Final = 24

FRAME_NUMBER_AND_TIMESTAMP: Final = {"big": struct.Struct(">iq"), "little": struct.Struct("<iq")}
"""The first two fields of Component.content: frame number, time stamp in µs."""
_ITEMS_OFFSET: Final = 16  # of the items in Component.content


class Component(NamedTuple):
    """One component of a frame.

    ``timestamp_us`` is the server's time stamp, "microseconds from start" (§7.1). ``content`` is the part
    after the size and type fields (frame number, time stamp, count, items), in ``byte_order``.
    ``item_bytes`` is 16 or 24 for events, and the size in ITEM_DTYPES for other components.
    """

    type: ComponentType
    frame_number: int
    timestamp_us: int
    num_items: int
    item_bytes: int
    byte_order: ByteOrder
    content: bytes

    def items(self) -> Items:
        """Return the items, shape (num_items,), as a read-only view of ``content``.

        The dtype is that of ITEM_DTYPES (SHORT_EVENT for events of 16 bytes) in ``byte_order``.
        """
        is_short_event = self.type is ComponentType.EVENT and self.item_bytes == SHORT_EVENT.itemsize
        dtype = SHORT_EVENT if is_short_event else ITEM_DTYPES[self.type]
        return np.frombuffer(
            self.content,
            dtype.newbyteorder(self.byte_order),
            self.num_items,
            _ITEMS_OFFSET,
        )


def big_endian_content(component: Component) -> bytes:
    """Return ``component.content`` in big-endian form; events keep their item size."""
    if component.byte_order == "big":
        return component.content
    header = struct.pack(">iqI", component.frame_number, component.timestamp_us, component.num_items)
    items = component.items()
    return header + items.astype(items.dtype.newbyteorder(">")).tobytes()


def encode_component(
    component: ComponentType,
    frame_number: int,
    timestamp_us: int,
    items: Items,
    byte_order: ByteOrder = "big",
) -> bytes:
    """Return the bytes of one component (§7.1 to §7.7) with ``items``, shape (num_items,).

    ``items`` has the dtype of ITEM_DTYPES in any byte order; events may be SHORT_EVENT instead.
    """
    data = items.astype(items.dtype.newbyteorder(byte_order), copy=False).tobytes()
    size = COMPONENT_HEADER_BYTES + len(data)
    return COMPONENT_HEADER[byte_order].pack(size, component, frame_number, timestamp_us, len(items)) + data


_MIN_HZ: Final = 0.01
_MAX_HZ: Final = 1e6
"""Numbers outside this range are not rates. Time stamps are whole µs (§7.1)."""


def described_rate_hz(parameters: Parameters, component: ComponentType) -> float | None:
    """Return the rate at which the server samples ``component``, in Hz; None if the parameters lack it.

    For analog and force, this is the highest rate of a channel or plate. A number that cannot be a rate, such
    as 0 for "not measured", counts as none.
    """
    if component is ComponentType.EVENT:
        return None
    if component in {ComponentType.MARKERS, ComponentType.TOOLS}:
        rates_hz = [getattr(SECTIONS[component.key].of(parameters), "frequency_hz", None)]
    else:
        rates_hz = [item.frequency_hz for item in SECTIONS[component.key].items_of(parameters)]
    rate_hz: float = max((rate_hz or 0 for rate_hz in rates_hz), default=0)
    return rate_hz if _MIN_HZ <= rate_hz <= _MAX_HZ else None


def num_described_items(parameters: Parameters, component: ComponentType) -> int:
    """Return the number of markers, tools, channels or plates in the parameters; 0 for events."""
    return 0 if component is ComponentType.EVENT else len(SECTIONS[component.key].items_of(parameters))


def described_labels(parameters: Parameters, component: ComponentType) -> list[str]:
    """Return the labels of the markers or tools, in their order in a frame; [] for other components."""
    has_labels = component in {ComponentType.MARKERS, ComponentType.TOOLS}
    return [item.label for item in SECTIONS[component.key].items_of(parameters)] if has_labels else []


def only_components(parameters: Parameters, components: Collection[ComponentType]) -> Parameters:
    """Return the parameters without the items of other components. The unit of all positions remains."""
    sections = {"events" if each is ComponentType.EVENT else each.key for each in components}
    kept = only_sections(parameters, {"general", *sections})
    if parameters.markers is not None and kept.markers is None:
        return replace(kept, markers=Parameters3D(unit=parameters.length_unit))
    return kept
