"""Playing a take in the viewer: the player, and its controls in the panel."""

import time
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final

import viser

from gateway.errors import SelectionError
from gateway.live.live_data import LiveData
from gateway.replay.play_list import Selection
from gateway.replay.player import Player
from gateway.replay.take_length import take_length_us
from gateway.replay.time_text import time_text
from gateway.safe_text import quoted, safe_text
from gateway.takes.reader import TakeReader

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
