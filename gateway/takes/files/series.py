"""One component of one source of a take, as numpy arrays, and at another rate, or as a table."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from gateway.rtc3d.components import ComponentType
from gateway.takes.files.component_rows import HEAD, NATIVE_ITEM_DTYPES, GrowingArray, Rows
from gateway.takes.files.parameters_history import ParametersEntry, entries_of_rows
from gateway.takes.files.resampling import resample
from gateway.takes.files.series_data import COLUMNS, SeriesContent, SeriesData
from gateway.takes.files.tables import to_pandas, to_xarray

if TYPE_CHECKING:
    import pandas as pd
    import xarray

MAX_GAP_S: Final = 0.1
"""Resampling interpolates across gaps up to this, unless told otherwise: 20 frames at 200 Hz."""


class Series(SeriesData):
    """A component of one source: arrays with one row per frame; of events, with one row per event.

    ``key`` is "3d", "6d", "analog", "force" or "event". The arrays have the shape (frames,):

    ======================  =======  ============================================================
    ``utime``               int64    when the gateway received the frame, in µs since 1970
    ``capture_utime``       int64    when the server captured it, on the same clock: use this time
    ``sequence``            int64    grows by one per message; a gap is a loss
    ``session``             int32    the number of the connection to the server
    ``parameters_version``  int32    the version of the parameters that describe the frame
    ``frame_number``        int32    the server's number, unchanged
    ``timestamp_us``        int64    the server's time stamp in µs since its start, unchanged
    ======================  =======  ============================================================

    docs/reference/messages.md describes them. The rows are in the order of their arrival. ``items`` has the
    values. ``start_utime`` is the time of the take's first event.
    """

    def resample(
        self,
        rate_hz: float,
        *,
        max_gap_s: float = MAX_GAP_S,
        from_s: float | None = None,
        to_s: float | None = None,
    ) -> Self:
        """Return the values at a constant rate: at multiples of 1 / ``rate_hz`` since the take's beginning.

        Positions, loads and analog values are interpolated linearly between the frames before and after,
        orientations by slerp. Between frames that are further apart than ``max_gap_s`` and one and a half
        periods, they are NaN, so ``max_gap_s=0`` fills no gap; so they are before the first and after the
        last frame, and between the runs (see ``runs``). A marker, tool, channel or plate that is missing in
        a frame is interpolated from those that have it.

        ``from_s`` and ``to_s`` are the first and the last second; the default are those of the frames.
        Nothing is filtered: use a low-pass filter before you reduce the rate of a signal that has higher
        frequencies. ``capture_utime`` has the new times, and the other columns are those of the nearest
        frame. Raises TakeError, also for events, which have no rate.
        """
        return resample(self, rate_hz, max_gap_s, from_s, to_s)

    def to_pandas(self) -> "pd.DataFrame":
        """Return a table with a row per frame or event, and the seconds as index ``time_s``.

        The columns are those of an exported table: ``capture_utime`` and other numbers of the frame, then the
        values, such as "head x". ``attrs["units"]`` has the units by column. Raises TakeError if pandas is
        not installed.
        """
        return to_pandas(self)

    def to_xarray(self) -> "xarray.Dataset":
        """Return a dataset with the dimension ``time`` in seconds, and one for the items.

        ======  =======================================================================================
        3d      ``position`` (time, marker, axis), ``reliability`` (time, marker)
        6d      ``position`` (time, tool, axis), ``quaternion`` (time, tool, part), ``error`` (time, tool)
        analog  ``value`` (time, channel)
        force   ``force`` (time, plate, axis), ``moment`` (time, plate, axis)
        event   ``id``, ``label`` and others (time)
        ======  =======================================================================================

        The items have their labels as coordinates, and their units as the coordinate ``unit``; ``attrs`` have
        the unit that all have in common. Raises TakeError if xarray is not installed.
        """
        return to_xarray(self)


class SeriesBuilder:
    """Collects the messages of one component; large arrays are on the disk if there is a ``spool_folder``."""

    def __init__(self, component: ComponentType, spool_folder: Path | None = None) -> None:
        self._component = component
        self._spool_folder = spool_folder
        self._columns = {
            name: GrowingArray(HEAD[name].newbyteorder("="), (), spool_folder) for name in COLUMNS
        }
        self._items: dict[int, GrowingArray] = {}

    def add(self, rows: Rows) -> None:
        """Append the content of messages."""
        heads, items = rows.heads, rows.items
        if self._component is ComponentType.EVENT:
            counts = heads["num_items"].astype(np.int64)
            heads = np.repeat(heads, counts)  # each event has a row of its own, in the order of the messages
            heads["num_items"] = 1
            events = np.empty((len(heads), 1), NATIVE_ITEM_DTYPES[ComponentType.EVENT])
            starts = np.cumsum(counts) - counts
            for num_items, values in items.items():
                places = starts[counts == num_items][:, None] + np.arange(num_items)
                events[places.ravel(), 0] = values.ravel()
            items = {1: events}
        for name, column in self._columns.items():
            column.extend(heads[name])
        for num_items, values in items.items():
            if num_items not in self._items:
                dtype = NATIVE_ITEM_DTYPES[self._component]
                self._items[num_items] = GrowingArray(dtype, (num_items,), self._spool_folder)
            self._items[num_items].extend(values)

    def build(self, parameters: Sequence[ParametersEntry], start_utime: int) -> Series | None:
        """Return what was collected, and forget it; None if it is nothing."""
        columns = {name: column.take() for name, column in self._columns.items()}
        recorded = {num_items: items.take() for num_items, items in self._items.items()}
        if not len(columns["utime"]):
            return None
        entries = entries_of_rows(columns["utime"], columns["parameters_version"], parameters)
        return Series(self._component, SeriesContent(columns, recorded, parameters, entries), start_utime)
