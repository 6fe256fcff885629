"""One frame of a component, and what it has in common with a whole series of them."""

from abc import ABC, abstractmethod
from typing import Final

import numpy as np

from gateway.config.words import spelling_hint
from gateway.errors import TakeError
from gateway.messages.descriptions.labels import Description, common, describe, event_labels
from gateway.rtc3d.components import ComponentType, is_visible
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import NATIVE_ITEM_DTYPES, Array

_MAX_SHOWN: Final = 20
"""How many labels an error lists."""

_QUALITY: Final = frozenset({"reliability", "error"})
"""The fields of items that are not their position, orientation, force or voltage."""


class ItemValues(ABC):
    """The values of a component: of one frame (``Row``), or of many, one per row (``Series``).

    … in a shape stands for the frames: nothing in a ``Row``, ``frames`` in a ``Series``. What is missing is
    NaN.
    """

    __slots__ = ()

    component: ComponentType

    @property
    @abstractmethod
    def items(self) -> Array:
        """The values as a structured array, shape (…, items)."""

    @property
    @abstractmethod
    def labels(self) -> tuple[str, ...]:
        """The names of the columns of ``items``, each different; () for events."""

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """The unit of each column."""

    @property
    def unit(self) -> str:
        """The unit of all columns; "" if they differ, or if it changes within the frames."""
        return common(self.units) or ""

    def __getitem__(self, label: str) -> Array:
        """Return the values of one item as plain numbers, float32; NaN if it is missing.

        Of a marker: x, y, z, shape (…, 3). Of a tool: q0, qx, qy, qz, x, y, z, shape (…, 7). Of a plate: fx,
        fy, fz, mx, my, mz, shape (…, 6). Of an analog channel: its value, shape (…). Raises KeyError.
        """
        values = self.values
        try:
            place = self.labels.index(label)
        except ValueError:
            shown = [*self.labels[:_MAX_SHOWN], *(["…"] if len(self.labels) > _MAX_SHOWN else [])]
            hint = spelling_hint(label, self.labels)
            raise KeyError(
                f"{self.component.key} has no {label!r}{hint}; it has {', '.join(shown)}"
            ) from None
        names = self.items.dtype.names
        if not names:
            return values[..., place]
        return values[..., place, : sum(name not in _QUALITY for name in names)]

    @property
    def values(self) -> Array:
        """``items`` as plain numbers, float32: shape (…, items, fields), of analog (…, items).

        It is a view. Events have integers of different sizes; use ``items``.
        """
        if self.component is ComponentType.EVENT:
            raise TakeError("events have integers of different sizes; use items instead of values")
        items = self.items
        if not items.dtype.names:
            return items
        return items.view(np.float32).reshape(*items.shape, len(items.dtype.names))

    @property
    def positions(self) -> Array:
        """The positions of markers or tools, float32, shape (…, items, 3), in ``unit``; NaN is missing.

        It is a view of ``items``.
        """
        return self.values[..., self._field("x") : self._field("z") + 1]

    @property
    def quaternions(self) -> Array:
        """The orientations of tools, float32, shape (…, tools, 4), scalar first: q0, qx, qy, qz.

        NaN is missing. It is a view of ``items``.
        """
        return self.values[..., self._field("q0") : self._field("qz") + 1]

    @property
    def quaternions_xyzw(self) -> Array:
        """The orientations of tools, float32, shape (…, tools, 4), scalar last: qx, qy, qz, q0, as in SciPy.

        NaN is missing.
        """
        return np.roll(self.quaternions, -1, axis=-1)

    @property
    def is_visible(self) -> Array:
        """Whether each marker or tool is visible, bool, shape (…, items)."""
        self._field("x")  # other components have none
        return is_visible(self.items)

    def _field(self, name: str) -> int:
        names = NATIVE_ITEM_DTYPES[self.component].names or ()
        if name not in names:
            key = self.component.key
            raise TakeError(f"{key} has no {name}; its fields are {', '.join(names) or 'plain numbers'}")
        return names.index(name)


class Row(ItemValues):
    """One frame of a component: what a ``Series`` has in one of its rows, without the axis of the frames.

    ``items`` has the shape (items,); of events, one item per event. ``parameters`` are the server's that
    describe it, without any section if they are not known.
    """

    __slots__ = ("_description", "_items", "component", "head", "parameters")

    def __init__(
        self,
        component: ComponentType,
        head: tuple[int, ...],
        items: Array,
        parameters: Parameters,
        description: Description | None = None,
    ) -> None:
        self.component = component
        self.head = head
        """What is before the items: the fields of HEAD."""
        self._items = items  # shape (1, items), as in Rows
        self.parameters = parameters
        self._description = description or describe(component, parameters, items.shape[1])

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<Row {self.key} {self.sequence}: {self._items.shape[1]} items>"

    @property
    def key(self) -> str:
        """The component: "3d", "6d", "analog", "force" or "event"."""
        return self.component.key

    @property
    def items(self) -> Array:
        """The values as a structured array, shape (items,); see ``Series.items``."""
        items: Array = self._items[0]
        return items

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the items, each different; () for events."""
        return self._description.labels

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each item: of positions, voltages or forces; "" if it is not known."""
        return self._description.units

    @property
    def moment_unit(self) -> str:
        """The unit of the plates' moments; "" if it is not known."""
        return self._description.moment_unit

    @property
    def rate_hz(self) -> float | None:
        """The rate of frames that the server announces; None if it announces none."""
        return self._description.rate_hz

    @property
    def event_labels(self) -> tuple[str, ...]:
        """The label of each event (§6.6); "" if the server gives none. Of events only."""
        if self.component is not ComponentType.EVENT:
            return ()
        names = event_labels(self.parameters)
        return tuple(names.get(number, "") for number in self.items["id"].tolist())

    @property
    def utime(self) -> int:
        """When the gateway received the frame, in µs since 1970 on its clock."""
        return self.head[1]

    @property
    def capture_utime(self) -> int:
        """When the server captured the frame, in µs since 1970 on the gateway's clock."""
        return self.head[2]

    @property
    def sequence(self) -> int:
        """The number of the message."""
        return self.head[3]

    @property
    def session(self) -> int:
        """The number of the connection to the server."""
        return self.head[4]

    @property
    def parameters_version(self) -> int:
        """The version of the parameters that describe the frame."""
        return self.head[5]

    @property
    def frame_number(self) -> int:
        """The server's number, unchanged."""
        return self.head[6]

    @property
    def timestamp_us(self) -> int:
        """The server's time stamp in µs since its start, unchanged."""
        return self.head[7]
