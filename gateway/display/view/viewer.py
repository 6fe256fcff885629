"""The view: what has arrived, live or from a take, is shown about 30 times a second."""

import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import viser

from gateway.client.transport import GatewaySubscriber
from gateway.display.live import LiveData
from gateway.display.view.panel import Panel
from gateway.display.view.scene import Scene
from gateway.display.view.server import ViewServer
from gateway.errors import GatewayError, SelectionError
from gateway.logs.safe_text import quoted, safe_text
from gateway.takes.files.reader import TakeReader
from gateway.takes.replay.play_list import Selection, take_length_us
from gateway.takes.replay.player import Player
from gateway.takes.replay.timeline import time_text

RATES: Final = {"0.1 ×": 0.1, "0.25 ×": 0.25, "0.5 ×": 0.5, "1 ×": 1.0, "2 ×": 2.0, "5 ×": 5.0, "10 ×": 10.0}
"""The speeds to choose from."""

_STEP_S: Final = 0.01
_SHOW_S: Final = 0.25
"""How often the time and the slider are shown."""

_HOLD_S: Final = 1.0
"""For how long the slider stays where the user has moved it."""

_STOP_S: Final = 2.0


class Playback:
    """A take that plays into ``live``, and its controls.

    ``sources`` are the sources to play; empty means all. Raises TakeError if there is no take, or if it has
    none of these sources.
    """

    def __init__(self, path: Path, sources: Collection[str], live: LiveData) -> None:
        self._reader = TakeReader(path)
        selection = Selection(sources=frozenset(sources) or None)
        _check_messages(self._reader, selection)
        self._live = live
        self._length_us = take_length_us(self._reader) or _length_by_reading_us(self._reader)
        self._player = Player(
            self._reader,
            selection,
            live,
            rate=1.0,
            is_watched=True,
        )
        self._has_begun = False
        self._shown_s = 0.0
        self._moved_s = 0.0

    @property
    def is_paused(self) -> bool:
        """Whether the picture stands still on purpose: in a pause, or at the end."""
        return self._player.is_paused or self._player.is_at_end

    def add_controls(self, gui: viser.GuiApi) -> None:
        """Add the controls to the panel, in the container that is open."""
        self._state = gui.add_markdown("")
        self._button = gui.add_button("Pause")
        self._button.on_click(self._toggle)
        length_s = max(round(self._length_us / 1e6, 2), _STEP_S)
        self._slider = gui.add_slider("Time (s)", 0.0, length_s, _STEP_S, 0.0)
        self._slider.on_update(self._seek)
        self._rate = gui.add_dropdown("Speed", [*RATES], initial_value="1 ×")
        self._rate.on_update(lambda _event: self._player.set_rate(RATES[self._rate.value]))
        self._loop = gui.add_checkbox("Repeat", False)
        self._loop.on_update(lambda _event: self._repeat(self._loop.value))

    def start(self) -> None:
        """Begin to play, unless it has begun."""
        if not self._has_begun:
            self._has_begun = True
            self._player.start()

    def update(self) -> None:
        """Show the time and the state. Call it often; raises what ended the player."""
        if self._player.error is not None:
            raise self._player.error
        now_s = time.monotonic()
        if now_s - self._shown_s < _SHOW_S:
            return
        self._shown_s = now_s
        self._state.content = self._state_text()
        self._button.label = "Play" if self.is_paused else "Pause"
        if now_s - self._moved_s > _HOLD_S:
            self._slider.value = min(self._player.position_us / 1e6, self._slider.max)  # type: ignore[misc]

    def close(self) -> None:
        """Stop playing."""
        if self._has_begun:
            self._player.stop()
            self._player.join(_STOP_S)

    def _state_text(self) -> str:
        player = self._player
        state = "at the end" if player.is_at_end else "paused" if player.is_paused else "playing"
        name = safe_text(self._reader.path.name).replace("`", "'")
        position, length = time_text(player.position_us), time_text(self._length_us)
        return f"`{name}`  \n**{position}** of {length}, {state}"

    # In the threads of viser.

    def _toggle(self, _event: Any) -> None:
        if self._player.is_at_end:
            self._go_to(0)
            self._player.pause(False)
        else:
            self._player.pause(not self._player.is_paused)

    def _seek(self, event: Any) -> None:
        if event.client_id is not None:  # moved by a user, and not by `update`
            self._moved_s = time.monotonic()
            self._go_to(round(self._slider.value * 1e6))

    def _go_to(self, position_us: int) -> None:
        self._live.begin_again()
        self._player.seek_to(position_us)

    def _repeat(self, is_repeated: bool) -> None:
        self._player.is_repeated = is_repeated


def _check_messages(reader: TakeReader, selection: Selection) -> None:
    """Raise SelectionError if nothing of the take is selected. This reads up to the first such message."""
    if any(selection.has(message.source, message.key) for message in reader.messages()):
        return
    existing = ", ".join(reader.source_names)
    shown = f" of {', '.join(map(quoted, selection.sources))}" if selection.sources else ""
    raise SelectionError(f"{reader.path} has no messages{shown}; sources of the take: {existing}")


def _length_by_reading_us(reader: TakeReader) -> int:
    """Return the time from the first to the last message, in µs. This reads the whole take."""
    last_utime = reader.start_utime
    for batches in reader.batches():
        last_utime = max(last_utime, *(batch.utimes[-1] for batch in batches))
    return last_utime - reader.start_utime


_TAKES_PERIOD_S: Final = 2.0


class RunningTakes:
    """Queries the gateways that have the output takes; ``is_watched`` says whether a page is open."""

    def __init__(
        self,
        live: LiveData,
        subscriber: GatewaySubscriber,
        is_watched: Callable[[], object],
        period_s: float = _TAKES_PERIOD_S,
    ) -> None:
        self._live = live
        self._subscriber = subscriber
        self._is_watched = is_watched
        self._period_s = period_s
        self._due_s = 0.0

    def tick(self) -> None:
        """Query if it is time. Call it often."""
        now_s = time.monotonic()
        if now_s < self._due_s or not self._is_watched():
            return
        self._due_s = now_s + self._period_s
        for source in self._live.sources_now:
            outputs = source.report.outputs if source.report else ()
            if any(output.output == "takes" for output in outputs):
                self._subscriber.query_takes(source)


PERIOD_S: Final = 1 / 30


class Viewer:
    """Shows the data of all sources, or of a take, to every browser that is connected."""

    def __init__(self, server: ViewServer, live: LiveData, playback: Playback | None = None) -> None:
        self._server = server
        self._live = live
        self._playback = playback
        if playback is not None:
            playback.add_controls(server.gui)
        tabs = server.gui.add_tab_group()
        self.panel = Panel(server, tabs, live, is_take=playback is not None)
        self.scene = Scene(server, tabs)
        self.num_defects = 0
        """How many pictures were not complete, because of a defect in this program."""

    def run(self, stops_within: Callable[[float], bool], tick: Callable[[], object]) -> None:
        """Show what arrives until ``stops_within``, which waits for some seconds, returns True.

        ``tick`` is called before each picture. The schedule is absolute, and pictures that are late are
        dropped. Without a browser, nothing is sent.
        """
        next_s = time.monotonic()
        while not stops_within(max(0.0, next_s - time.monotonic())):
            tick()
            self._update_or_report()
            now_s = time.monotonic()
            next_s += PERIOD_S * max(1, -(-(now_s - next_s) // PERIOD_S))

    def _update_or_report(self) -> None:
        """Show what has arrived. A defect, or what a page should not send, does not end the view."""
        try:
            self.update()
        except GatewayError:
            raise
        except Exception as defect:  # noqa: BLE001 - the next picture may be whole
            if self.num_defects == 0:
                text = f"defect in rtc3d-gateway view: {type(defect).__name__}: {defect}; report this"
                print(safe_text(text), file=sys.stderr, flush=True)
            self.num_defects += 1

    def update(self) -> None:
        """Decode what has arrived, and show it. Raises what ended the playback of a take."""
        clients = self._server.get_clients()
        if clients and self._playback is not None:
            self._playback.start()  # not before: a short take would be over
        is_paused = self._playback is not None and self._playback.is_paused
        if is_paused:
            self._live.hold()
        sources = self._live.update()
        if clients:
            with self._server.atomic():
                self.scene.update(sources, clients)
        else:
            self.scene.pause()
        self.panel.update(sources, is_paused=is_paused)
        if self._playback is not None:
            self._playback.update()
