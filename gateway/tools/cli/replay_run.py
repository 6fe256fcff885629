"""One run of ``replay``: the player, the keys, the progress, and the report."""

import asyncio
import contextlib
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from gateway.messages.topics import MAX_SOURCES
from gateway.rtc3d.components import WIRE_ORDER
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_text
from gateway.takes.files.reader import TakeReader
from gateway.tools.display.terminal import keys
from gateway.tools.replay.play_list import Selection, take_length_us
from gateway.tools.replay.player import Player
from gateway.tools.replay.publication import MAX_TOPICS, Publication
from gateway.tools.replay.replay import Destination, open_publication, playing
from gateway.tools.replay.timeline import Jump, time_text

LINE_S: Final = 5.0
"""How often a line is printed if stderr is no terminal."""

_MAX_LISTED: Final = 10
_ORDER: Final = (*(component.key for component in WIRE_ORDER), "6d/tool", "status", "clock", "parameters")


def jump_text(jump: Jump) -> str:
    """Return a line that says what happens where the time of the messages jumps."""
    where, source = time_text(jump.position_us), safe_text(jump.source)
    if not jump.is_skipped:
        return f"{where}  nothing was recorded for {jump.jump_us / 1e6:.1f} s"
    length = time_text(abs(jump.jump_us))
    if jump.jump_us < 0:
        return f"{where}  the time of {source} goes back by {length}: its clock was set; the replay goes on"
    return (
        f"{where}  nothing was recorded for {length}, or the clock of {source} was set; "
        "the replay goes on at once"
    )


class Progress:
    """One line on ``console`` that is kept up to date; without a terminal, one every few seconds.

    If it is ``quiet``, there is none.
    """

    def __init__(
        self, console: Console, player: Player, length_us: int | None, hints: str, *, quiet: bool
    ) -> None:
        self._player = player
        self._length_us = length_us
        self._hints = hints
        self._console = console
        self._quiet = quiet
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._before = time.monotonic(), player.control.position_us, 0, 0  # when the line was shown last
        if console.is_terminal and not quiet:
            self._live.start()

    def show(self) -> None:
        """Show where the replay is. Call it a few times a second."""
        if self._quiet:
            return
        if self._console.is_terminal:
            self._live.update(Text(self._text(), no_wrap=True, overflow="ellipsis"), refresh=True)
        elif time.monotonic() - self._before[0] >= LINE_S:
            self._console.print(self._text(), soft_wrap=True, highlight=False)

    def close(self) -> None:
        """Remove the line."""
        self._live.stop()

    def _text(self) -> str:
        player = self._player
        now_s, position_us, num_messages = time.monotonic(), player.control.position_us, player.num_messages
        before_s, before_us, before_messages, before_passes = self._before
        self._before = now_s, position_us, num_messages, player.num_passes
        passed_s = max(now_s - before_s, 1e-6)
        parts = [time_text(position_us)]
        if self._length_us:
            parts[0] += f" of {time_text(self._length_us)}"
        if player.num_passes:
            parts.append(f"repetition {player.num_passes}")
        if player.control.is_paused:
            parts.append("paused")
        else:
            if position_us >= before_us and player.num_passes == before_passes:
                parts.append(f"{(position_us - before_us) / 1e6 / passed_s:,.2f}×")
            parts.append(f"{(num_messages - before_messages) / passed_s:,.0f} messages/s")
            if player.pace is not None and player.pace.lateness.num_messages:
                parts.append(f"late by {1e3 * player.pace.lateness.quantile_s(0.99):.1f} ms (p99)")
        if self._hints:
            parts.append(self._hints)
        return "  ".join(parts)


def print_report(
    console: Console, notes: Console, player: Player, publication: Publication, reader: TakeReader
) -> None:
    """Print the messages per component on ``console``, and on ``notes`` what was left out and why."""
    outputs = sorted({refusal.output for refusal in publication.refusals})
    table = Table()
    for heading in ("component", "messages", *(f"refused by {output}" for output in outputs)):
        table.add_column(heading, justify="left" if heading == "component" else "right")
    order = {key: place for place, key in enumerate(_ORDER)}
    for key in sorted(publication.num_messages, key=lambda key: (order.get(key, len(order)), key)):
        refused: Counter[str] = Counter()
        for refusal, count in publication.refusals.items():
            if refusal.key == key:
                refused[refusal.output] += count
        cells = [f"{refused[output]:,}" for output in outputs]
        table.add_row(key, f"{publication.num_messages[key]:,}", *cells)
    console.print(table)
    total, seconds = publication.num_messages.total(), player.seconds
    text = f"{total:,} messages in {seconds:.1f} s ({total / max(seconds, 1e-6):,.0f} messages/s)"
    if player.pace is not None and player.pace.lateness.num_messages:
        late = player.pace.lateness
        p50, p99 = late.quantile_s(0.5), late.quantile_s(0.99)
        text += (
            f"; late by {1e3 * p50:.1f} ms (p50), {1e3 * p99:.1f} ms (p99), {1e3 * late.max_s:.1f} ms at most"
        )
    console.print(text, highlight=False, soft_wrap=True)
    for note in _notes(player, publication, reader):
        notes.print(Text(note), soft_wrap=True)


def _notes(player: Player, publication: Publication, reader: TakeReader) -> Iterator[str]:
    for refusal, count in publication.refusals.items():
        yield f"{refusal.output} did not take {count:,} messages of {refusal.key} ({refusal.cause})"
    if player.pace is not None and player.pace.stalled_s:
        yield (
            f"the replay stood still for {player.pace.stalled_s:.1f} s, because the process was stopped, or "
            "the disk or an output did not respond; it did not catch up"
        )
    for source in sorted(publication.without_parameters):
        yield f"the take has no parameters of {safe_text(source)} at the beginning, so no labels and units"
    for source, count in publication.num_unreadable.items():
        yield f"{count:,} messages of {safe_text(source)} are damaged and were left out"
    if publication.num_surplus:
        yield (
            f"{publication.num_surplus:,} messages were left out, because the take has more than "
            f"{MAX_SOURCES} sources or {MAX_TOPICS} keys"
        )
    if reader.unknown:
        channels = [safe_text(channel) for channel, _ in reader.unknown.most_common(_MAX_LISTED)]
        more = ", …" if len(reader.unknown) > _MAX_LISTED else ""
        yield (
            f"{reader.unknown.total():,} messages of other programs or versions were left out, on "
            f"{', '.join(channels)}{more}"
        )
    yield from _file_notes(reader)


def _file_notes(reader: TakeReader) -> Iterator[str]:
    for source in reader.cut_off_sources():
        yield f"INCOMPLETE: the recording of {safe_text(source)} was cut off, so its end is missing"
    for log in reader.logs:
        if log.damaged_bytes:
            places = counted(log.num_damaged, "place")
            yield f"{log.path} is damaged: {log.damaged_bytes:,} bytes in {places} were left out"
    for problem in reader.empty_files.values():
        yield f"left out: {safe_text(problem)}"


_SEEK_US: Final = 10_000_000
_SHOW_S: Final = 0.25
_STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


async def run_replay(
    reader: TakeReader,
    selection: Selection,
    destinations: Sequence[Destination],
    *,
    rate: float | None,
    is_repeated: bool,
    max_gap_s: float,
    are_required: bool,
    quiet: bool,
) -> bool:
    """Replay until the end, q or a signal; return whether the outputs took everything."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in _STOP_SIGNALS:
        loop.add_signal_handler(number, stop.set)
    notes = Console(stderr=True)

    def note(text: str) -> None:
        notes.print(Text(text), soft_wrap=True)

    def on_jump(jump: Jump) -> None:
        loop.call_soon_threadsafe(note, jump_text(jump))

    async with open_publication(destinations, are_required=are_required, warn=note) as publication:
        opened = [each for each in destinations if each.output.health().connected]
        places = [f"on {each.kind.name} under {each.request.prefix}" for each in opened]
        note(f"publishing {' and '.join(places)}")
        if not stop.is_set():
            player = Player(
                reader,
                selection,
                publication,
                rate=rate,
                is_repeated=is_repeated,
                max_gap_s=max_gap_s,
                on_jump=on_jump,
            )
            length_us = take_length_us(reader, selection.stop_us)
            try:
                await _play(
                    player, publication, stop, partial(Progress, notes, player, length_us, quiet=quiet)
                )
            finally:
                if player.num_messages:
                    print_report(Console(), notes, player, publication, reader)
    if not publication.num_messages:
        note("nothing was replayed")
    return not publication.refusals


async def _play(
    player: Player, publication: Publication, stop: asyncio.Event, progress_with: Callable[[str], Progress]
) -> None:
    control = player.control

    def toggle_pause() -> None:
        control.pause(not control.is_paused)
        publication.show_streaming(not control.is_paused)

    actions = {
        "space": toggle_pause,
        "q": stop.set,
        "left": lambda: control.seek(-_SEEK_US),
        "right": lambda: control.seek(_SEEK_US),
    }
    with keys(actions) as has_keys:
        hints = "space: pause, ←/→: 10 s, q: quit" if has_keys else ""
        with closing(progress_with(hints)) as progress:
            async with playing(player):
                while player.is_alive and not stop.is_set():
                    progress.show()
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(stop.wait(), _SHOW_S)
