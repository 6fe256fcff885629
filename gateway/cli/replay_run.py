"""One run of ``replay``: the player, the keys, the progress, the report."""

import asyncio
import contextlib
import signal
from collections.abc import Sequence
from contextlib import closing
from typing import Final

from rich.console import Console
from rich.text import Text

from gateway.cli.replay_report import Progress, jump_text, print_report
from gateway.replay.destinations import Destination
from gateway.replay.play_list import Selection
from gateway.replay.player import Player
from gateway.replay.publication import Publication
from gateway.replay.replay import open_publication, playing
from gateway.replay.take_length import take_length_us
from gateway.replay.timeline import Jump
from gateway.takes.reader import TakeReader
from gateway.terminal.keyboard import keys

_SEEK_US: Final = 10_000_000
_SHOW_S: Final = 0.25
_STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class ReplayRun:
    """One run of the command."""

    def __init__(
        self,
        reader: TakeReader,
        selection: Selection,
        rate: float | None,
        *,
        is_repeated: bool,
        max_gap_s: float,
        quiet: bool,
    ) -> None:
        self._reader = reader
        self._selection = selection
        self._rate = rate
        self._is_repeated = is_repeated
        self._max_gap_s = max_gap_s
        self._quiet = quiet
        self._out = Console()
        self._notes = Console(stderr=True)

    async def replay(self, destinations: Sequence[Destination], *, are_required: bool) -> bool:
        """Replay until the end, q or a signal; return whether the outputs took everything."""
        stop = asyncio.Event()
        for number in _STOP_SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        async with open_publication(destinations, are_required=are_required, warn=self._note) as publication:
            opened = [each for each in destinations if each.output.health().connected]
            places = [f"on {each.kind.name} under {each.request.prefix}" for each in opened]
            self._note(f"publishing {' and '.join(places)}")
            if not stop.is_set():
                await self._play(publication, stop)
        if not publication.num_messages:
            self._note("nothing was replayed")
        return not publication.refusals

    async def _play(self, publication: Publication, stop: asyncio.Event) -> None:
        loop = asyncio.get_running_loop()

        def on_jump(jump: Jump) -> None:
            loop.call_soon_threadsafe(self._note, jump_text(jump))

        player = Player(
            self._reader,
            self._selection,
            publication,
            rate=self._rate,
            is_repeated=self._is_repeated,
            max_gap_s=self._max_gap_s,
            on_jump=on_jump,
        )

        def toggle_pause() -> None:
            player.pause(not player.is_paused)
            publication.show_streaming(not player.is_paused)

        actions = {
            "space": toggle_pause,
            "q": stop.set,
            "left": lambda: player.seek(-_SEEK_US),
            "right": lambda: player.seek(_SEEK_US),
        }
        try:
            with keys(actions) as has_keys:
                hints = "space: pause, ←/→: 10 s, q: quit" if has_keys else ""
                length_us = take_length_us(self._reader, self._selection.stop_us)
                with closing(Progress(self._notes, player, length_us, hints, quiet=self._quiet)) as progress:
                    async with playing(player):
                        while player.is_alive and not stop.is_set():
                            progress.show()
                            with contextlib.suppress(TimeoutError):
                                await asyncio.wait_for(stop.wait(), _SHOW_S)
        finally:
            if player.num_messages:
                print_report(self._out, self._notes, player, publication, self._reader)

    def _note(self, text: str) -> None:
        self._notes.print(Text(text), soft_wrap=True)
