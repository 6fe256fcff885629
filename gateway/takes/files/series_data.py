"""The numpy arrays of one component of one source of a take, with what the parameters say about them."""

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple, Self

import numpy as np

from gateway.errors import TakeError
from gateway.messages.descriptions.labels import Description, common, describe, event_labels
from gateway.rtc3d.components import MISSING, ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.takes.files.component_rows import (
    HEAD,
    NATIVE_ITEM_DTYPES,
    Array,
    find_restarts,
)
from gateway.takes.files.parameters_history import ParametersEntry
from gateway.takes.files.row import ItemValues
from gateway.takes.files.spool import pieces

COLUMNS: Final = tuple(name for name in HEAD.names or () if name != "fingerprint")
"""The columns of a series, which the head of each message has."""

_NEIGHBOURS: Final = 20
"""How many rows beside two tell whether something starts again between them; some may have no time stamp."""

MAX_PADDING: Final = 4
"""How many times as large as what was recorded arrays may become, by labels that change or by resampling."""
MIN_LIMIT_BYTES: Final = 256 * 1024 * 1024
"""Arrays of this size are always possible."""


class SeriesContent(NamedTuple):
    """What a ``Series`` is made of.

    ``columns`` has its columns by name, and ``num_items``; ``recorded`` the items by their number, as in
    ``Rows`` (of events, all below 1); ``entries`` the index in ``parameters`` of those that describe each
    row, -1 if there are none.
    """

    columns: dict[str, Array]
    recorded: dict[int, Array]
    parameters: Sequence[ParametersEntry]
    entries: Array

    @property
    def num_items(self) -> Array:
        """How many items each row has."""
        return self.columns["num_items"]

    def parameters_of(self, entry: int) -> Parameters | None:
        """Return the parameters with an index of ``entries``; None if it is -1."""
        return self.parameters[entry].parameters if entry >= 0 else None

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<SeriesContent: {len(self.entries)} rows, {len(self.parameters)} parameters>"


class SeriesData(ItemValues):
    """What was recorded of a component, and what describes it: a ``Series`` without its conversions."""

    utime: Array
    capture_utime: Array
    sequence: Array
    session: Array
    parameters_version: Array
    frame_number: Array
    timestamp_us: Array

    def __init__(
        self,
        component: ComponentType,
        content: SeriesContent,
        start_utime: int,
        resampled_hz: float | None = None,
    ) -> None:
        self.component = component
        self._content = content
        self.start_utime = start_utime
        for name in COLUMNS:
            setattr(self, name, content.columns[name])
        self._resampled_hz = resampled_hz

    def __len__(self) -> int:
        """Return the number of frames (of events: the number of events)."""
        return len(self.utime)

    def __repr__(self) -> str:
        """Return a summary."""
        return f"<Series {self.key}: {len(self)} rows, {len(self.labels)} labels>"

    @property
    def content(self) -> SeriesContent:
        """What this series was made of, to make another one of it."""
        return self._content

    @property
    def key(self) -> str:
        """The component: "3d", "6d", "analog", "force" or "event"."""
        return self.component.key

    @property
    def seconds(self) -> Array:
        """The time of capture in seconds since the beginning of the take, float64, shape (frames,)."""
        return self.seconds_of(self.capture_utime)

    def seconds_of(self, utime: Array) -> Array:
        """Return times in µs since 1970 as seconds since the beginning of the take, float64."""
        return (utime - self.start_utime) / 1e6

    def parameters_of(self, row: int) -> Parameters:
        """Return the server's parameters that describe a row; without any section if the take has none."""
        entry = int(self.content.entries[row])
        return self.content.parameters_of(entry) or Parameters()

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The names of the columns of ``items``, each different; () for events.

        If the labels change within the take, these are all labels that occur.
        """
        return tuple(dict.fromkeys(label for layout in self._layouts.values() for label in layout.labels))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """The unit of each column: of positions, voltages or forces; "" if it is not known or changes."""
        found: dict[str, set[str]] = {label: set() for label in self.labels}
        for layout in self._layouts.values():
            for label, unit in zip(layout.labels, layout.units, strict=True):
                found[label].add(unit)
        return tuple(common(units) or "" for units in found.values())

    @property
    def moment_unit(self) -> str:
        """The unit of the plates' moments; "" if it is not known, or changes."""
        return common(layout.moment_unit for layout in self._layouts.values()) or ""

    @property
    def rate_hz(self) -> float | None:
        """The rate of frames that the server announces; None if it announces none, or it changes.

        Of what ``resample`` returns, it is the new rate.
        """
        return self._resampled_hz or common(layout.rate_hz for layout in self._layouts.values())

    @cached_property
    def measured_rate_hz(self) -> float | None:
        """The rate of the recorded frames by the server's time stamps, without gaps; None if unknown.

        If the time stamps are constant, it is computed from the times of arrival.
        """
        if self._resampled_hz:
            return self._resampled_hz
        for times in (self.timestamp_us, self.utime):
            step_us = regular_step(
                np.diff(times)[(np.diff(self.sequence) == 1) & (np.diff(self.session) == 0)]
            )
            if step_us is not None:
                return 1e6 / step_us
        return None

    @cached_property
    def items(self) -> Array:
        """The values as a structured array, shape (frames, items), with a column for each of ``labels``.

        The fields are those of the message: x, y, z, reliability (markers); q0, qx, qy, qz, x, y, z, error
        (tools); fx, fy, fz, mx, my, mz (plates). Analog is plain float32. What is missing is NaN; so are the
        columns of labels that do not exist in a frame. Of events, the shape is (events,), with the fields id,
        timestamp (µs), param1, param2, param3.

        Raises TakeError if the labels change so much that this array would be several times as large as the
        recording; use ``runs`` then.
        """
        content = self.content
        if self.component is ComponentType.EVENT:
            return content.recorded[1][:, 0]
        if len(content.recorded) == 1 and len({layout.labels for layout in self._layouts.values()}) == 1:
            return next(iter(content.recorded.values()))
        dtype = NATIVE_ITEM_DTYPES[self.component]
        recorded_bytes = sum(items.nbytes for items in content.recorded.values())
        num_bytes = len(self) * len(self.labels) * dtype.itemsize
        if num_bytes > max(MAX_PADDING * recorded_bytes, MIN_LIMIT_BYTES):
            raise TakeError(
                f"the labels of {self.key} change so often that an array with all {len(self.labels)} of them "
                f"would take {num_bytes / 1e9:.1f} GB; read the parts with equal labels one by one: runs()"
            )
        items = np.full((len(self), len(self.labels)), MISSING, np.float32 if not dtype.names else dtype)
        columns = {label: column for column, label in enumerate(self.labels)}
        rows_of = {number: np.flatnonzero(content.num_items == number) for number in content.recorded}
        for (entry, num_items), layout in self._layouts.items():
            rows = rows_of[num_items]
            chosen = content.entries[rows] == entry
            places = np.array([columns[label] for label in layout.labels], np.intp)
            items[rows[chosen][:, None], places] = content.recorded[num_items][chosen]
        return items

    @property
    def event_labels(self) -> tuple[str, ...]:
        """The label of each event (§6.6), one per row; "" if the server gives none. Of events only."""
        if self.component is not ComponentType.EVENT:
            return ()
        names = {
            entry: event_labels(self.content.parameters_of(entry))
            for entry in np.unique(self.content.entries).tolist()
        }
        rows = zip(self.content.entries.tolist(), self.items["id"].tolist(), strict=True)
        return tuple(names[entry].get(number, "") for entry, number in rows)

    def runs(self) -> list[Self]:
        """Return the parts with constant labels, units and rates, in their order; they share the memory.

        A part also ends where the server's time stamps or frame numbers start again (a new measurement, or a
        new start of the server), where another session begins, and where the gateway starts again.
        """
        if not len(self):
            return []
        content = self.content
        starts = [0, *self._starts(), len(self)]
        before = dict.fromkeys(content.recorded, 0)
        runs = []
        for start, stop in pairwise(starts):
            num_items = int(content.num_items[start])
            first = before[num_items]
            before[num_items] += stop - start
            recorded = {num_items: content.recorded[num_items][first : before[num_items]]}
            columns = {name: values[start:stop] for name, values in content.columns.items()}
            runs.append(self._part(columns, recorded, content.entries[start:stop]))
        return runs

    def _starts(self) -> list[int]:
        """Return the rows but the first with which a run begins."""
        starts: list[int] = []
        for start, stop in pieces(len(self)):
            # What happens between two rows is told from them and their neighbours.
            near = slice(max(start - _NEIGHBOURS, 0), stop + _NEIGHBOURS)
            restarts = find_restarts(
                self.utime[near], self.sequence[near], self.timestamp_us[near], self.frame_number[near]
            )
            is_start = (np.diff(self.session[near]) != 0) | restarts.sequence | restarts.server
            if self.component is not ComponentType.EVENT:
                is_start |= np.diff(self._layout_numbers(near)) != 0
            found = np.flatnonzero(is_start) + near.start + 1
            starts += found[(found > start) & (found <= stop) & (found < len(self))].tolist()
        return starts

    def without_empty_frames(self) -> Self:
        """Return the frames that have items; all frames if none has."""
        content = self.content
        has_items = content.num_items > 0
        if has_items.all() or not has_items.any():
            return self
        columns = {name: values[has_items] for name, values in content.columns.items()}
        recorded = {num_items: items for num_items, items in content.recorded.items() if num_items}
        return self._part(columns, recorded, content.entries[has_items])

    def with_constant_labels(self) -> Self:
        """Return the frames with as many items each as the parameters have at most, NaN where one is missing.

        The number of markers changes from frame to frame if a server sends unlabelled ones. Frames whose
        labels would take several times as much memory as was recorded stay as they are.
        """
        content = self.content
        most = max(content.recorded, default=0)
        sizes: dict[tuple[str, ...], int] = {}
        labels: dict[int, tuple[str, ...]] = {}
        for entry, num_items in self._layouts:
            parameters = content.parameters_of(entry)
            labels[entry] = describe(self.component, parameters, most).labels
            sizes[labels[entry]] = max(sizes.get(labels[entry], 0), num_items)
        if all(sizes[labels[entry]] == num_items for entry, num_items in self._layouts):
            return self
        padded = np.zeros(len(self), content.num_items.dtype)
        for entry, found in labels.items():
            padded[content.entries == entry] = sizes[found]
        item_bytes = NATIVE_ITEM_DTYPES[self.component].itemsize
        recorded_bytes = int(content.num_items.sum(dtype=np.int64)) * item_bytes
        if padded.sum(dtype=np.int64) * item_bytes > max(MAX_PADDING * recorded_bytes, MIN_LIMIT_BYTES):
            return self
        recorded = {}
        for number in np.unique(padded).tolist():
            (rows,) = np.nonzero(padded == number)
            counts = content.num_items[rows]
            items = np.full((len(rows), number), MISSING, NATIVE_ITEM_DTYPES[self.component])
            for count in np.unique(counts).tolist():
                places = padded[content.num_items == count] == number
                items[counts == count, :count] = content.recorded[count][places]
            recorded[number] = items
        return self._part(content.columns | {"num_items": padded}, recorded, content.entries)

    def rows(self, chosen: Array) -> Self:
        """Return some of the rows of a run, in which all have the same number of items."""
        content = self.content
        [(num_items, items)] = content.recorded.items()
        columns = {name: values[chosen] for name, values in content.columns.items()}
        return self._part(columns, {num_items: items[chosen]}, content.entries[chosen])

    def _part(self, columns: dict[str, Array], recorded: dict[int, Array], entries: Array) -> Self:
        """Return a series of some of the rows."""
        content = SeriesContent(columns, recorded, self.content.parameters, entries)
        return type(self)(self.component, content, self.start_utime, self._resampled_hz)

    @cached_property
    def _layouts(self) -> dict[tuple[int, int], Description]:
        """What describes rows, by index in ``content.parameters`` and number of items, as they appear."""
        layouts: dict[tuple[int, int], Description] = {}
        for start, stop in pieces(len(self)):
            pairs = np.stack([self.content.entries[start:stop], self.content.num_items[start:stop]], axis=1)
            unique, first = np.unique(pairs, axis=0, return_index=True)
            for entry, num_items in unique[np.argsort(first)].tolist():
                if (entry, num_items) not in layouts:
                    parameters = self.content.parameters_of(entry)
                    layouts[entry, num_items] = describe(self.component, parameters, num_items)
        return layouts

    def _layout_numbers(self, rows: slice) -> Array:
        """Return a number for each of some rows; rows with the same number have the same description."""
        numbers: dict[Description, int] = {}
        entries, num_items = self.content.entries[rows], self.content.num_items[rows]
        result = np.zeros(len(entries), np.int64)
        for (entry, count), layout in self._layouts.items():
            number = numbers.setdefault(layout, len(numbers))
            if number:
                result[(entries == entry) & (num_items == count)] = number
        return result


def regular_step(steps: Array) -> float | None:
    """Return the mean of the steps, without those that are not positive or differ from the others by half.

    Returns None if there are none.
    """
    steps = steps[steps > 0]
    if not len(steps):
        return None
    median = np.quantile(steps, 0.5, method="lower")  # one of them, so that at least this one remains
    return float(steps[abs(steps - median) <= median / 2].mean())
