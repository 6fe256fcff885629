"""``rtc3d-gateway replay``: publish a take again."""

import asyncio
import contextlib
import gc
import re
import signal
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Final

import typer
import uvloop
from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from rich.text import Text

from gateway.cli.keyboard import keys
from gateway.cli.options import (
    ComponentsOption,
    ConnectOption,
    ListenOption,
    SourcesOption,
    UrlOption,
    ZenohConfigOption,
    checked_key_prefix,
)
from gateway.cli.replay_report import Progress, jump_text, print_report
from gateway.outputs.lcm.settings import ChannelPrefix
from gateway.replay.destinations import Destination, ZenohAddress, lcm_destination, zenoh_destination
from gateway.replay.play_list import Selection
from gateway.replay.player import Player
from gateway.replay.publication import Publication
from gateway.replay.replay import open_publication, playing
from gateway.replay.take_length import take_length_us
from gateway.replay.timeline import MAX_GAP_S, Jump
from gateway.service.log_format import LogLevel, set_up_log
from gateway.takes.reader import TakeReader

_SEEK_US: Final = 10_000_000
_SWITCH_S: Final = 0.0005
"""How long another thread that runs Python, such as that of the progress, may keep the replay waiting."""

_SHOW_S: Final = 0.25
_MAX_RATE: Final = 1000.0
_MIN_RATE: Final = 0.01
_STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


def _checked_rate(text: str) -> str:
    if text != "max":
        try:
            is_valid = _MIN_RATE <= float(text) <= _MAX_RATE
        except ValueError:
            is_valid = False
        if not is_valid:
            raise typer.BadParameter(f"expected a number from {_MIN_RATE:g} to {_MAX_RATE:g}, or max")
    return text


def replay(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The take: a recording (.lcmlog), or the folder of one.")
    ],
    rate: Annotated[
        str,
        typer.Option(
            callback=_checked_rate,
            help=f"How many times as fast as recorded, {_MIN_RATE:g} to {_MAX_RATE:g}, or max: no waiting.",
        ),
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")] = False,
    from_s: Annotated[
        float, typer.Option("--from", min=0, help="Where to begin, in s from the take's first message.")
    ] = 0.0,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to", min=0, help="Where to end, in s from the first message; the default is its end."
        ),
    ] = None,
    source: SourcesOption = None,
    component: ComponentsOption = None,
    prefix: Annotated[
        str,
        typer.Option(
            callback=checked_key_prefix,
            help="The prefix on Zenoh; that on LCM is the same in upper case, with _ for other characters.",
        ),
    ] = "replay",
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Only on Zenoh.")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Only on LCM.")] = False,
    connect: ConnectOption = None,
    listen: ListenOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    max_gap: Annotated[
        float, typer.Option(min=0, help="Skip longer gaps in which nothing was recorded, in s.")
    ] = MAX_GAP_S,
) -> None:
    """Publish a take again on Zenoh and LCM, under a prefix of its own.

    Keys: space pauses and continues, ← and → go 10 s back and forth, q quits. Exit status 1 if an output did
    not take everything.
    """
    if zenoh and lcm:
        raise typer.BadParameter("give either --zenoh or --lcm")
    if lcm and (connect or listen or zenoh_config):
        raise typer.BadParameter("--connect, --listen and --zenoh-config are for Zenoh")
    if zenoh and url:
        raise typer.BadParameter("--url is for LCM")
    if listen and (connect or zenoh_config):
        raise typer.BadParameter("give either --listen, or --connect and --zenoh-config")
    if to_s is not None and to_s <= from_s:
        raise typer.BadParameter("--to must be greater than --from")
    set_up_log(LogLevel.WARNING)
    sys.setswitchinterval(_SWITCH_S)
    gc.freeze()  # or a full garbage collection looks through all modules, which takes 20 ms
    destinations = []
    if not lcm:
        destinations.append(zenoh_destination(prefix, ZenohAddress(connect, listen, zenoh_config)))
    if not zenoh:
        destinations.append(lcm_destination(lcm_prefix(prefix), url))
    selection = Selection(
        frozenset(source) if source else None,
        frozenset(component) if component else None,
        round(from_s * 1e6),
        None if to_s is None else round(to_s * 1e6),
    )
    pace = None if rate == "max" else float(rate)
    run = _Run(TakeReader(file), selection, pace, is_repeated=loop, max_gap_s=max_gap)
    if not uvloop.run(run.replay(destinations, are_required=zenoh or lcm)):
        raise typer.Exit(1)


def lcm_prefix(prefix: str) -> str:
    """Return the prefix of LCM channels for one of Zenoh keys; raises BadParameter if there is none."""
    channels = re.sub(r"[^A-Z0-9]+", "_", prefix.upper())
    try:
        return str(TypeAdapter(ChannelPrefix).validate_python(channels))
    except ValidationError:
        raise typer.BadParameter(
            f"--prefix {prefix} gives {channels} on LCM, where at most 16 characters are possible; "
            "choose a shorter one, or --zenoh"
        ) from None


class _Run:
    """One run of the command."""

    def __init__(
        self,
        reader: TakeReader,
        selection: Selection,
        rate: float | None,
        *,
        is_repeated: bool,
        max_gap_s: float,
    ) -> None:
        self._reader = reader
        self._selection = selection
        self._rate = rate
        self._is_repeated = is_repeated
        self._max_gap_s = max_gap_s
        self._out = Console()
        self._notes = Console(stderr=True)

    async def replay(self, destinations: Sequence[Destination], *, are_required: bool) -> bool:
        """Replay until the end, q or a signal; return whether the outputs took everything."""
        stop = asyncio.Event()
        for number in _STOP_SIGNALS:
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        async with open_publication(destinations, are_required=are_required, warn=self._note) as publication:
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
                with closing(
                    Progress(
                        self._notes, player, take_length_us(self._reader, self._selection.stop_us), hints
                    )
                ) as progress:
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
