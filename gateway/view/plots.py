"""Scrolling plots of selected analog and force channels."""

import time
from collections.abc import Sequence
from typing import Final

import numpy as np
import viser
from viser import uplot

from gateway.live.component import LiveComponent
from gateway.live.live_data import LiveSource
from gateway.takes.component_rows import Array
from gateway.view.channels import Channel, choices, component_of, first_choice, samples
from gateway.view.envelope import COLUMN_US, NUM_COLUMNS, Envelope

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

_COLUMNS: Final = np.arange(1 - NUM_COLUMNS, 1)


class _Plot:
    """The plot of one channel."""

    def __init__(self, server: viser.ViserServer, channel: Channel, title: str) -> None:
        self.channel = channel
        self._envelope = Envelope()
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

    def take(self, component: LiveComponent | None) -> None:
        """Take what came since the last call."""
        self._component = component
        if component is not None:
            for utimes, values in samples(self.channel, component):
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
        self._choices: dict[str, Channel] = {}
        self._plots: dict[str, _Plot] = {}  # by their titles
        self._has_begun = False
        """Whether somebody has chosen a channel, or the first one was chosen for them."""

    def take(self, sources: Sequence[LiveSource]) -> None:
        """Take what came since the last call."""
        if self._plots:
            by_name = {source.name: source for source in sources}
            for plot in self._plots.values():
                plot.take(component_of(plot.channel, by_name))

    def show(self) -> None:
        """Send the plots to the browsers."""
        for plot in self._plots.values():
            plot.show()

    def follow_user(self) -> None:
        """Add and remove the plots that the user chose."""
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

    def _plot(self, title: str) -> None:
        self._has_begun = True
        with self._folder:
            self._plots[title] = _Plot(self._server, self._choices[title], title)

    def offer(self, sources: Sequence[LiveSource]) -> None:
        """Offer the channels that there are now. The first time that they are known, plot a useful one."""
        former, self._choices = self._choices, choices(sources)
        first = first_choice(self._choices)
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
