"""The panel beside the picture: state, rates, latency, losses, visibility, events and plots."""

import time
from collections.abc import Callable, Sequence
from typing import Final

import viser

from gateway.live.live_data import LiveData, LiveSource
from gateway.view.banner import MAX_SOURCES, banner_html
from gateway.view.item_tables import events_html, items_html
from gateway.view.plots import Plots
from gateway.view.shown_latency import ShownLatency
from gateway.view.source_text import ignored_html, source_html
from gateway.view.style import STYLE

_PLOT_INTERVAL_S: Final = 0.1
_BANNER_INTERVAL_S: Final = 0.25
_TEXT_INTERVAL_S: Final = 1.0

_WIDTH_PX: Final = 410
"""The tables need it."""

_MIN_WINDOW_PX: Final = 720
"""In a narrower window, the panel is closed at first. On phones, viser has a sheet instead: see style.py."""


class Panel:
    """The tabs of the panel, and above them a banner that says whether the picture is live.

    Texts are built a few times per second, and only while somebody looks. viser sends those that change.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        tabs: viser.GuiTabGroupHandle,
        live: LiveData,
        *,
        is_take: bool = False,
    ) -> None:
        self._server = server
        self._live = live
        self._is_take = is_take
        self._is_paused = False
        self._shown_latency = ShownLatency()
        self._stopped: tuple[bool, ...] = ()
        server.gui.main_panel.set_width(_WIDTH_PX)
        server.on_client_connect(_close_in_narrow_window)
        server.gui.add_html(STYLE, order=-2)
        self._banner = server.gui.add_html("", order=-1)
        with tabs.add_tab("Sources"):
            self._sources = server.gui.add_html("")
        with tabs.add_tab("Markers"):
            self._items = server.gui.add_html("")
        with tabs.add_tab("Events"):
            self._events = server.gui.add_html("")
        with tabs.add_tab("Plots"):
            self._plots = Plots(server)
        # Not all texts in the same turn: the picture would wait for them.
        self._turns = [
            _Turn(_BANNER_INTERVAL_S, 0.0, self._show_banner),
            _Turn(_TEXT_INTERVAL_S, 0.05, self._show_sources),
            _Turn(_TEXT_INTERVAL_S, 0.15, self._show_items),
            _Turn(_TEXT_INTERVAL_S, 0.35, self._show_events),
            _Turn(_TEXT_INTERVAL_S, 0.45, self._plots.offer),
            _Turn(_PLOT_INTERVAL_S, 0.0, self._show_plots),
        ]

    def update(self, sources: list[LiveSource], *, is_paused: bool = False) -> None:
        """Show the sources as they are now. Call it after the picture was sent, at every picture.

        ``is_paused`` says that a take stands still on purpose.
        """
        self._is_paused = is_paused
        self._shown_latency.add(sources)
        self._plots.take(sources)
        if not self._server.get_clients():
            return
        now_s = time.monotonic()
        stopped = tuple(source.is_stopped for source in sources)
        if stopped != self._stopped:  # said at once
            self._stopped = stopped
            self._show_banner(sources)
        for turn in self._turns:
            turn.run(sources, now_s)

    def _show_banner(self, sources: Sequence[LiveSource]) -> None:
        self._banner.content = _block(
            banner_html(sources, time.time(), is_take=self._is_take, is_paused=self._is_paused)
        )

    def _show_sources(self, sources: Sequence[LiveSource]) -> None:
        texts = [
            source_html(
                source,
                self._shown_latency.percentiles(source.name),
                is_take=self._is_take,
                is_paused=self._is_paused,
            )
            for source in sources[:MAX_SOURCES]
        ]
        self._sources.content = _block(*texts, ignored_html(self._live))

    def _show_items(self, sources: Sequence[LiveSource]) -> None:
        self._items.content = _block(*map(items_html, sources[:MAX_SOURCES]))

    def _show_events(self, sources: Sequence[LiveSource]) -> None:
        self._events.content = _block(*map(events_html, sources[:MAX_SOURCES]))

    def _show_plots(self, _: Sequence[LiveSource]) -> None:
        self._plots.follow_user()
        self._plots.show()


class _Turn:
    """Something that is shown at an interval, first after a delay."""

    def __init__(
        self, interval_s: float, delay_s: float, show: Callable[[Sequence[LiveSource]], None]
    ) -> None:
        self._interval_s = interval_s
        self._due_s = time.monotonic() + delay_s
        self._show = show

    def run(self, sources: Sequence[LiveSource], now_s: float) -> None:
        """Show it if it is due."""
        if now_s < self._due_s:
            return
        self._due_s += self._interval_s
        if self._due_s <= now_s:  # nobody looked, or the computer was busy
            self._due_s = now_s + self._interval_s
        self._show(sources)


def _close_in_narrow_window(client: viser.ClientHandle) -> None:
    if client.camera.image_width < _MIN_WINDOW_PX:
        client.gui.main_panel.minimize()


def _block(*parts: str) -> str:
    return f"<div class=gateway>{''.join(parts)}</div>"
