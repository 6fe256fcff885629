"""``rtc3d-gateway replay``: publish a take again."""

import re
from pathlib import Path
from typing import Annotated, Final

import typer

from gateway.runtime.log_format import LogLevel, set_up_log
from gateway.runtime.process_start import keep_event_loop_responsive
from gateway.tools.cli import options
from gateway.tools.cli.completion import take_files
from gateway.tools.replay.timeline import MAX_GAP_S

_MAX_RATE: Final = 1000.0
_MIN_RATE: Final = 0.01


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
        Path,
        typer.Argument(
            metavar="FILE",
            autocompletion=take_files,
            help="The take: a recording (.lcmlog), or the folder of one.",
        ),
    ],
    rate: Annotated[
        str,
        typer.Option(
            callback=_checked_rate,
            help=f"How many times as fast as recorded, {_MIN_RATE:g} to {_MAX_RATE:g}, or max: no waiting.",
        ),
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="Begin again at the end, until Ctrl-C.")] = False,
    from_s: options.FromOption = 0.0,
    to_s: options.ToOption = None,
    source: options.SourcesOption = None,
    component: options.ComponentsOption = None,
    prefix: Annotated[
        str,
        typer.Option(
            callback=options.checked_key_prefix,
            help="The prefix on Zenoh; that on LCM is the same in upper case, with _ for other characters.",
        ),
    ] = "replay",
    zenoh: Annotated[bool, typer.Option("--zenoh", help="Only on Zenoh.")] = False,
    lcm: Annotated[bool, typer.Option("--lcm", help="Only on LCM.")] = False,
    connect: options.ConnectOption = None,
    listen: options.ListenOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    url: options.UrlOption = None,
    max_gap: Annotated[
        float, typer.Option(min=0, help="Skip longer gaps in which nothing was recorded, in s.")
    ] = MAX_GAP_S,
    quiet: options.NoProgressOption = False,
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
    if to_s is not None and to_s <= (from_s or 0.0):
        raise typer.BadParameter("--to must be greater than --from")
    import uvloop

    from gateway.takes.files.reader import TakeReader
    from gateway.tools.cli.replay_run import run_replay
    from gateway.tools.replay.play_list import Selection
    from gateway.tools.replay.replay import lcm_destination, zenoh_destination

    set_up_log(LogLevel.WARNING)
    keep_event_loop_responsive()
    destinations = []
    if not lcm:
        destinations.append(zenoh_destination(prefix, connect, listen, zenoh_config))
    if not zenoh:
        destinations.append(lcm_destination(lcm_prefix(prefix), url))
    selection = Selection(
        frozenset(source) if source else None,
        frozenset(component) if component else None,
        round((from_s or 0.0) * 1e6),
        None if to_s is None else round(to_s * 1e6),
    )
    run = run_replay(
        TakeReader(file),
        selection,
        destinations,
        rate=None if rate == "max" else float(rate),
        is_repeated=loop,
        max_gap_s=max_gap,
        are_required=zenoh or lcm,
        quiet=quiet,
    )
    if not uvloop.run(run):
        raise typer.Exit(1)


def lcm_prefix(prefix: str) -> str:
    """Return the prefix of LCM channels for one of Zenoh keys; raises BadParameter if there is none."""
    from pydantic import TypeAdapter, ValidationError

    from gateway.config.values import ChannelPrefix

    channels = re.sub(r"[^A-Z0-9]+", "_", prefix.upper())
    try:
        return str(TypeAdapter(ChannelPrefix).validate_python(channels))
    except ValidationError:
        raise typer.BadParameter(
            f"--prefix {prefix} gives {channels} on LCM, where at most 16 characters are possible; "
            "choose a shorter one, or --zenoh"
        ) from None
