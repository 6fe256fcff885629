"""Scrolling plots of selected analog and force channels."""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import viser
from viser import uplot

from gateway.rtc3d.components import ITEM_DTYPES, ComponentType
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.component_rows import Array, Rows
from gateway.tools.display.live import DisplayedSource, LiveComponent

MAX_CHOICES: Final = 1000
"""How many channels can be chosen from."""

_MAX_LABEL_CHARACTERS: Final = 32

_KEYS: Final = (ComponentType.ANALOG.key, ComponentType.FORCE.key)
_FIELDS: Final = ITEM_DTYPES[ComponentType.FORCE].names or ()


@dataclass(frozen=True, slots=True)
class PlotChannel:
    """A channel of a source: an analog channel, or one field of a force plate.

    ``position`` is that of the channel or the plate, ``field`` is "" for analog channels.
    """

    source: str
    key: str
    position: int
    field: str


def choices(sources: Sequence[DisplayedSource]) -> dict[str, PlotChannel]:
    """Return the channels that can be plotted, at most MAX_CHOICES, by what they are called."""
    found: dict[str, PlotChannel] = {}
    for source in sources:
        for channel, text in _channels(source):
            if len(found) == MAX_CHOICES:
                return found
            found[text] = channel
    return found


def _channels(source: DisplayedSource) -> Iterator[tuple[PlotChannel, str]]:
    for key in _KEYS:
        component = source.components.get(key)
        if component is None:
            continue
        description = component.description
        labels, units = (map(_cut, texts[:MAX_CHOICES]) for texts in (description.labels, description.units))
        moment_unit = _cut(description.moment_unit)
        for position, (label, unit) in enumerate(zip(labels, units, strict=True)):
            # Labels that are cut may be equal; the number distinguishes them.
            name = f"{_cut(source.name)} {key} {position + 1}: {label}"
            for field in _FIELDS if key == ComponentType.FORCE.key else ("",):
                of_field = moment_unit if field.startswith("m") else unit
                words = [name, field.capitalize(), f"({of_field})" if of_field else ""]
                yield PlotChannel(source.name, key, position, field), " ".join(filter(None, words))


def _cut(text: str) -> str:
    return safe_text(text, _MAX_LABEL_CHARACTERS)


def samples(channel: PlotChannel, batch: Rows) -> Iterator[tuple[Array, Array]]:
    """Return the samples of a channel in messages of its component: times and values.

    Times are those of capture, in µs since the Unix epoch on the gateway's clock.
    """
    for num_items, items in batch.items.items():
        if channel.position >= num_items:
            continue
        utimes = batch.heads["capture_utime"]
        if len(batch.items) > 1:
            utimes = utimes[batch.heads["num_items"] == num_items]
        values = items[:, channel.position]
        yield utimes, values[channel.field] if channel.field else values


NUM_COLUMNS: Final = 320
COLUMN_US: Final = 31_250
"""320 columns of 31.25 ms are 10 s."""

_COLUMNS: Final = np.arange(1 - NUM_COLUMNS, 1)

_MAX_STEP_COLUMNS: Final = 32
"""If times go back, or forward, by more than a second, the envelope starts again there.

A plot would connect the values before and after a gap, as if there had been some between them.
"""


class Envelope:
    """The smallest and the largest value of a channel in each column of a plot.

    Every sample of the last NUM_COLUMNS columns, and since the last gap, is within them. Values that are not
    finite are missing. Times are µs since the Unix epoch.
    """

    def __init__(self) -> None:
        self._values = np.full((2, NUM_COLUMNS), np.nan)  # the smallest ones, and the largest ones
        self._newest: int | None = None  # the newest column, counted from the epoch

    @property
    def newest_utime(self) -> int | None:
        """The begin of the newest column; None before the first sample."""
        return None if self._newest is None else self._newest * COLUMN_US

    def add(self, utimes: Array, values: Array) -> None:
        """Take samples, two arrays of shape (samples,), nearly in the order of their times."""
        if not len(utimes):
            return
        columns = utimes.astype(np.int64) // COLUMN_US
        values = values.astype(np.float64)
        values[~np.isfinite(values)] = np.nan
        # One step for each run of samples in the same column.
        begins = np.concatenate([[0], 1 + np.flatnonzero(np.diff(columns))])
        lowest, highest = np.fmin.reduceat(values, begins), np.fmax.reduceat(values, begins)
        for column, low, high in zip(columns[begins].tolist(), lowest, highest, strict=True):
            self._make_room(column)
            smallest, largest = self._values[:, column % NUM_COLUMNS]
            self._values[:, column % NUM_COLUMNS] = np.fmin(smallest, low), np.fmax(largest, high)

    def columns(self, end_utime: int) -> Array:
        """Return the smallest and the largest values, oldest first, shape (2, NUM_COLUMNS).

        The last column is that of ``end_utime``. Columns without a sample are NaN.
        """
        newest = self._newest
        if newest is None:
            return self._values.copy()
        wanted = end_utime // COLUMN_US + _COLUMNS
        is_kept = (wanted <= newest) & (wanted > newest - NUM_COLUMNS)
        return np.where(is_kept, self._values[:, wanted % NUM_COLUMNS], np.nan)

    def _make_room(self, column: int) -> None:
        newest = self._newest
        if newest is None or abs(column - newest) > _MAX_STEP_COLUMNS:
            self._values[:] = np.nan
        elif column > newest:
            self._values[:, np.arange(newest + 1, column + 1) % NUM_COLUMNS] = np.nan
        else:
            return
        self._newest = column


MAX_RECENT_BYTES: Final = 64 * 1024 * 1024
"""How much all components keep for plots that are added: 10 s of 256 channels at 2000 Hz need 21 MB."""


class RecentRows:
    """The messages of a component whose samples a plot shows: one that is added shows them at once."""

    def __init__(self) -> None:
        self.batches: deque[Rows] = deque()
        """The oldest first."""
        self._num_bytes = 0

    def take(self, batch: Rows, max_bytes: int) -> None:
        """Take messages, and forget what is too old, or more than ``max_bytes``."""
        if not len(batch.heads):
            return
        self.batches.append(batch)
        self._num_bytes += _num_bytes(batch)
        oldest_utime = batch.heads["capture_utime"][-1] - NUM_COLUMNS * COLUMN_US
        while self._num_bytes > max_bytes or self.batches[0].heads["capture_utime"][-1] < oldest_utime:
            self._num_bytes -= _num_bytes(self.batches.popleft())


def _num_bytes(batch: Rows) -> int:
    return batch.heads.nbytes + sum(items.nbytes for items in batch.items.values())


MAX_PLOTS: Final = 8

_NOTE: Final = (
    f"<div class=gateway>Up to {MAX_PLOTS} channels, from the smallest to the largest value of all frames. "
    "All viewers see the same plots.</div>"
)
_NO_CHANNELS: Final = "<div class=gateway>No analog or force channels have come yet.</div>"
_CHOOSE: Final = "choose …"
_ALL: Final = "all"
_HEIGHT_PX: Final = 120
_FONT: Final = "11px sans-serif"
_LINE: Final = "#4dabf7"
_FILL: Final = "rgba(77, 171, 247, 0.35)"


class _Plot:
    """The plot of one channel."""

    def __init__(
        self, server: viser.ViserServer, channel: PlotChannel, title: str, recent: Iterable[Rows]
    ) -> None:
        self.channel = channel
        self._envelope = Envelope()
        for batch in recent:
            self._add(batch)
        self._component: LiveComponent | None = None
        line = uplot.Series(label="", stroke=_LINE, width=1, spanGaps=False, points={"show": False})
        no_ticks = uplot.Axis_Ticks(show=False)
        self.handle = server.gui.add_uplot(
            self._data(time.time_ns() // 1000),
            (uplot.Series(label="time"), line, line),
            title=title,
            bands=(uplot.Band(series=(2, 1), fill=_FILL),),
            scales={"x": uplot.Scale(time=True), "y": uplot.Scale()},
            axes=(
                uplot.Axis(size=24, font=_FONT, ticks=no_ticks, values="{HH}:{mm}:{ss}", space=70),
                uplot.Axis(size=52, font=_FONT, ticks=no_ticks),
            ),
            legend=uplot.Legend(show=False),
            height=_HEIGHT_PX,
            padding=(8, 8, 0, 0),
        )

    def take(self, source: DisplayedSource | None) -> None:
        """Take what came since the last call."""
        component = self._component = source.components.get(self.channel.key) if source else None
        if component is not None:
            self._add(component.batch)

    def _add(self, batch: Rows) -> None:
        for utimes, values in samples(self.channel, batch):
            self._envelope.add(utimes, values)

    def show(self) -> None:
        """Send the plot to the browsers. It scrolls on when data have stopped."""
        end_utime, component = self._envelope.newest_utime, self._component
        if end_utime is not None:
            if component is not None and component.is_stopped:
                end_utime += round(1e6 * (component.age_s or 0.0))
            self.handle.data = self._data(end_utime)

    def _data(self, end_utime: int) -> tuple[Array, Array, Array]:
        """Return the times of the columns in seconds since the Unix epoch, and the envelope.

        The y axis follows the values because the times change: viser fits a plot only then. It cannot fit
        a plot that begins with NaN, so the columns before the first value are left out.
        """
        lowest, highest = self._envelope.columns(end_utime)
        times_s = (end_utime // COLUMN_US + _COLUMNS) * (COLUMN_US / 1e6)
        first = int(np.argmax(np.isfinite(lowest)))
        return times_s[first:], lowest[first:], highest[first:]


class Plots:
    """The tab in which a user chooses channels and sees their plots. All viewers see the same ones."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._note = server.gui.add_html(_NO_CHANNELS)
        self._add = server.gui.add_dropdown("Plot", [_CHOOSE], visible=False)
        self._remove = server.gui.add_dropdown("Remove", [_CHOOSE], visible=False)
        self._folder = server.gui.add_folder(None)
        self._choices: dict[str, PlotChannel] = {}
        self._plots: dict[str, _Plot] = {}  # by their titles
        self._recent: dict[tuple[str, str], RecentRows] = {}  # by source and key of a component
        self._has_begun = False
        """Whether somebody has chosen a channel, or the first one was chosen for them."""

    def take(self, sources: Sequence[DisplayedSource]) -> None:
        """Take what came since the last call."""
        by_name = {source.name: source for source in sources}
        batches = {
            (source.name, key): source.components[key].batch
            for source in sources
            for key in _KEYS
            if key in source.components
        }
        self._recent = {each: self._recent.get(each, RecentRows()) for each in batches}
        for each, batch in batches.items():
            self._recent[each].take(batch, MAX_RECENT_BYTES // len(batches))
        for plot in self._plots.values():
            plot.take(by_name.get(plot.channel.source))

    def show(self) -> None:
        """Add and remove the plots that the user chose, and send them to the browsers."""
        added, removed = self._add.value, self._remove.value
        if added in self._choices and len(self._plots) < MAX_PLOTS and added not in self._plots:
            self._plot(added)
        for title in [*self._plots] if removed == _ALL else [removed]:
            plot = self._plots.pop(title, None)
            if plot is not None:
                plot.handle.remove()
        if added != _CHOOSE or removed != _CHOOSE:
            self._add.value = _CHOOSE  # type: ignore[misc] # mypy does not find the setter
            self._remove.value = _CHOOSE  # type: ignore[misc]
            self._offer()
        for plot in self._plots.values():
            plot.show()

    def _plot(self, title: str) -> None:
        self._has_begun = True
        channel = self._choices[title]
        recent = self._recent.get((channel.source, channel.key), RecentRows())
        with self._folder:
            self._plots[title] = _Plot(self._server, channel, title, recent.batches)

    def offer(self, sources: Sequence[DisplayedSource]) -> None:
        """Offer the channels that there are now. The first time that they are known, plot a useful one."""
        former, self._choices = self._choices, choices(sources)
        forces = [text for text, channel in self._choices.items() if channel.field == "fz"]
        first = next(iter([*forces, *self._choices]), None)  # what most people look at first
        # Once the channels of the same sources and components came twice, no more come a moment later.
        if first and not self._has_begun and self._add.value == _CHOOSE and [*former] == [*self._choices]:
            self._plot(first)
        titles = {plot.channel: title for title, plot in self._plots.items()}
        for text, channel in self._choices.items():
            title = titles.get(channel, text)
            if title != text:
                plot = self._plots.pop(title)
                plot.handle.title = text
                self._plots[text] = plot
        self._offer()

    def _offer(self) -> None:
        is_full = len(self._plots) == MAX_PLOTS
        offered = (text for text in self._choices if text not in self._plots and not is_full)
        _set_options(self._add, (_CHOOSE, *offered))
        _set_options(self._remove, (_CHOOSE, *self._plots, *([_ALL] if len(self._plots) > 1 else [])))
        self._note.content = _NOTE if self._choices else _NO_CHANNELS
        self._add.visible, self._remove.visible = bool(self._choices), bool(self._plots)


def _set_options(dropdown: viser.GuiDropdownHandle[str], options: tuple[str, ...]) -> None:
    if dropdown.options != options:  # viser sends them in any case
        dropdown.options = options
