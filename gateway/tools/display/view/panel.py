"""The panel beside the picture: state, rates, latency, losses, visibility, events and plots."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import viser

from gateway.messages.descriptions.force_plates import METRES_PER_NEWTON, UpAxis
from gateway.messages.source_report import Level, State
from gateway.runtime.quantities import counted
from gateway.tools.display.live import DisplayedSource, LiveData
from gateway.tools.display.view.page import STYLE
from gateway.tools.display.view.plots import Plots
from gateway.tools.display.view.scene_items import UP_AXES, Rgb
from gateway.tools.display.view.texts import (
    clock_text,
    data_state,
    events_html,
    gateway_states,
    html_text,
    ignored_html,
    items_html,
    notice_text,
    source_html,
    title_text,
)

MAX_SHOWN_SOURCES: Final = 16
"""How many sources the panel shows."""

_MAX_CHARACTERS: Final = 160


def banner_html(
    sources: Sequence[DisplayedSource], now_s: float, *, is_take: bool = False, is_paused: bool = False
) -> str:
    """Return a line for each source: red, with the reason, if its data have stopped.

    ``now_s`` is the time since the Unix epoch. ``is_paused`` is for takes: nothing comes, on purpose.
    """
    lines = [f"<p class=waiting>{'The take begins.' if is_take else 'No source is heard yet.'}</p>"]
    if sources:
        lines = [_banner_line(each, now_s, is_take, is_paused) for each in sources[:MAX_SHOWN_SOURCES]]
    if len(sources) > MAX_SHOWN_SOURCES:
        lines.append(f"<p class=dim>and {counted(len(sources) - MAX_SHOWN_SOURCES, 'more source')}</p>")
    # The second changes as long as this program runs; otherwise, the page itself says so (page.py).
    return f"<section data-second={int(now_s)}>{''.join(lines)}</section>"


def _state(source: DisplayedSource, is_take: bool, is_paused: bool) -> State:
    state = data_state(source)
    if is_take and is_paused:
        return State(Level.WAITING, "paused")
    if is_take and state.level is Level.GOOD:
        return State(Level.GOOD, "recorded")
    return state


def _banner_line(source: DisplayedSource, now_s: float, is_take: bool, is_paused: bool) -> str:
    name, state, last, recording = html_text(source.name), _state(source, is_take, is_paused), "", ""
    if not is_take:
        age_s = source.age_s
        last = "" if age_s is None else f"last data {clock_text(now_s - age_s)}"
        if source.running_take and not source.is_silent:
            take = html_text(source.running_take, _MAX_CHARACTERS)
            recording = f"<p><span class=bad>● recording</span> {take}</p>"
    text = html_text(state.text, _MAX_CHARACTERS)
    if state.level is Level.BAD and not is_take:
        reasons = ", ".join(each.text for each in gateway_states(source) if each.level is not Level.GOOD)
        details = html_text(" · ".join(filter(None, (last, reasons))), _MAX_CHARACTERS)
        line = f"<div class=stopped><b>{name}: {text}</b>. The picture is old.<br>{details}</div>"
    else:
        state_text = f"<span class={state.level.value}>● {text}</span>"
        line = f"<p>{state_text} <b>{name}</b> <span class=last>{last}</span></p>"
    return line + recording


_LEGEND: Final = (
    f"<div class=gateway>Yellow arrows are forces: 1 m for {1 / METRES_PER_NEWTON:.0f} N. Axes are tools: "
    "red x, green y, blue z. What is grey is not live.</div>"
)


class Switches:
    """The switches of the scene, common to all browsers. ``fit`` is called with the browser that wants it."""

    def __init__(
        self, server: viser.ViserServer, tab: viser.GuiTabHandle, fit: Callable[[viser.ClientHandle], object]
    ) -> None:
        self._server = server
        self._tab = tab
        with tab:
            hint = "Move the camera so that it sees the data of the last 10 s. The key F does the same."
            button = server.gui.add_button("Fit view (F)", hint=hint)
            self.marker_labels = server.gui.add_checkbox("Marker labels", initial_value=False)
            self.tool_labels = server.gui.add_checkbox("Tool labels", initial_value=True)
            self.links = server.gui.add_checkbox("Links", initial_value=True)
            self.trails = server.gui.add_checkbox("Marker trails", initial_value=True)
            self.floor = server.gui.add_checkbox("Floor", initial_value=True)
            self._up = server.gui.add_dropdown(
                "Up axis", UP_AXES, initial_value="z", hint="The axis of the laboratory that points up."
            )
            themes = server.gui.add_button_group("Background", ("dark", "light"))
            self._group = server.gui.add_folder("Sources")
            server.gui.add_html(_LEGEND)
        self.has_chosen_up = False
        """Whether somebody has chosen the axis that points up."""

        def fit_view(event: viser.GuiEvent[viser.GuiButtonHandle] | viser.CommandEvent) -> None:
            if event.client is not None:
                fit(event.client)

        button.on_click(fit_view)
        server.gui.add_command("Fit view", hotkey="F").on_trigger(fit_view)

        @self._up.on_update
        def _(event: viser.GuiEvent[viser.GuiDropdownHandle[UpAxis]]) -> None:
            self.has_chosen_up |= event.client is not None

        @themes.on_click
        def _(event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
            if event.client is not None:
                set_theme(event.client.gui, dark=themes.value == "dark")

    @property
    def up(self) -> UpAxis:
        """The axis that points up; z if a page has sent anything else."""
        chosen = self._up.value
        return chosen if chosen in UP_AXES else "z"

    def suggest_up(self, up: UpAxis | None) -> None:
        """Choose the axis that points up, unless somebody has chosen it, or it is not known."""
        if up is not None and not self.has_chosen_up:
            self._up.value = up  # type: ignore[misc] # mypy does not find the setter

    def add_source(self, name: str, color: Rgb) -> viser.GuiCheckboxHandle:
        """Add the switch of a source, with a stripe in its colour."""
        with self._group:
            style = f"margin: 0 0.8em; height: 3px; background: rgb{color}"
            self._server.gui.add_html(f'<div style="{style}"></div>')
            return self._server.gui.add_checkbox(name, initial_value=True)


@dataclass
class _Turn:
    """What is shown at an interval, next at ``due_s``."""

    interval_s: float
    due_s: float
    show: Callable[[Sequence[DisplayedSource]], None]


_PLOT_INTERVAL_S: Final = 0.1
_BANNER_INTERVAL_S: Final = 0.25
_TEXT_INTERVAL_S: Final = 1.0

_WIDTH_PX: Final = 410
"""The tables need it."""

_MIN_WINDOW_PX: Final = 720
"""In a narrower window, the panel is closed at first. On phones, viser has a sheet instead: see _SCRIPT."""


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
        self._stopped: tuple[bool, ...] = ()
        server.gui.main_panel.set_width(_WIDTH_PX)
        server.gui.add_html(STYLE, order=-2)
        self._title = ""
        self._notice = server.scene.add_label("/notice", "", visible=False)
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
        now_s = time.monotonic()
        self._turns = [
            _Turn(_BANNER_INTERVAL_S, now_s, self._show_banner),
            _Turn(_TEXT_INTERVAL_S, now_s + 0.05, self._show_sources),
            _Turn(
                _TEXT_INTERVAL_S,
                now_s + 0.15,
                lambda sources: _show(self._items, map(items_html, sources[:MAX_SHOWN_SOURCES])),
            ),
            _Turn(
                _TEXT_INTERVAL_S,
                now_s + 0.35,
                lambda sources: _show(self._events, map(events_html, sources[:MAX_SHOWN_SOURCES])),
            ),
            _Turn(_TEXT_INTERVAL_S, now_s + 0.45, self._plots.offer),
            _Turn(_PLOT_INTERVAL_S, now_s, lambda _: self._plots.show()),
        ]

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            if client.camera.image_width < _MIN_WINDOW_PX:
                client.gui.main_panel.minimize()

    def update(self, sources: list[DisplayedSource], *, is_paused: bool = False) -> None:
        """Show the sources as they are now. Call it after the picture was sent, at every picture.

        ``is_paused`` says that a take stands still on purpose.
        """
        self._is_paused = is_paused
        for source in sources:
            for component in [*source.components.values()]:
                component.note_shown()
        self._plots.take(sources)
        if not self._server.get_clients():
            return
        now_s = time.monotonic()
        stopped = tuple(source.is_stopped for source in sources)
        if stopped != self._stopped:  # said at once
            self._stopped = stopped
            self._show_banner(sources)
        for turn in self._turns:
            if now_s >= turn.due_s:
                turn.due_s += turn.interval_s
                if turn.due_s <= now_s:  # nobody looked, or the computer was busy
                    turn.due_s = now_s + turn.interval_s
                turn.show(sources)

    def _show_banner(self, sources: Sequence[DisplayedSource]) -> None:
        banner = banner_html(sources, time.time(), is_take=self._is_take, is_paused=self._is_paused)
        _show(self._banner, [banner])
        self._notice.text = "" if self._is_take else notice_text(sources, time.time())
        states = [_state(each, self._is_take, self._is_paused) for each in sources]
        title = title_text(sources, states)
        if title != self._title:
            self._title = title
            self._server.gui.set_panel_label(title)

    def _show_sources(self, sources: Sequence[DisplayedSource]) -> None:
        shown = sources[:MAX_SHOWN_SOURCES]
        texts = [source_html(each, is_take=self._is_take, is_paused=self._is_paused) for each in shown]
        _show(self._sources, [*texts, ignored_html(self._live)])


def _show(tab: viser.GuiHtmlHandle, parts: Iterable[str]) -> None:
    tab.content = f"<div class=gateway>{''.join(parts)}</div>"


def set_theme(gui: viser.GuiApi, *, dark: bool) -> None:
    """Choose the colours of the page, of all browsers or of one."""
    gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False)
