"""``rtc3d-gateway take``: what recordings contain, and recording in a gateway."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gateway.cli.options import (
    ConnectOption,
    DetailsOptions,
    NoProgressOption,
    PrefixOption,
    QueryOptions,
    SourceOption,
    ZenohConfigOption,
    checked_take_name,
    with_options,
)
from gateway.logs.safe_text import safe_json, safe_text

if TYPE_CHECKING:
    from gateway.cli.take_list import ListedTake
    from gateway.client.client import TakeReplies

app = typer.Typer(
    no_args_is_help=True, help="Inspect recordings (takes), and control those of running gateways."
)

_NameArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="NAME",
        callback=checked_take_name,
        help="The name of the take; the default is SOURCE-DATE-TIME.",
    ),
]
_LcmOption = Annotated[bool, typer.Option("--lcm", help="Ask on LCM instead of Zenoh.")]
_JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object, with the sources as keys.")]


@app.command()
@with_options
def start(
    name: _NameArgument = None,
    *,
    details: DetailsOptions,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    query: QueryOptions,
) -> None:
    """Start a take in a running gateway. Needs takes.enabled and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    described = details.checked()
    with query.client(lcm=lcm) as client:
        replies = client.start_take(name, described, source=source)
    _print_replies(replies, lambda take: f"take {take.name!r} is running", as_json=as_json)


@app.command()
@with_options
def stop(
    *,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    query: QueryOptions,
) -> None:
    """Stop the running take.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else, also a take that lacks messages.
    """
    with query.client(lcm=lcm) as client:
        replies = client.stop_take(source=source)
    _print_replies(replies, lambda take: f"take {take.name!r} is stopped: {take.facts}", as_json=as_json)


@app.command()
@with_options
def save(
    name: _NameArgument = None,
    *,
    last: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=3600.0, help="How many of the last seconds; the default is all that are kept."
        ),
    ] = None,
    after: Annotated[float, typer.Option(min=0.0, max=3600.0, help="For how many seconds to go on.")] = 0.0,
    details: DetailsOptions,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    query: QueryOptions,
) -> None:
    """Keep the last seconds as a take. Needs takes.keep_last_s and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    described = details.checked()
    with query.client(lcm=lcm) as client:
        replies = client.save_take(name, described, last_s=last, after_s=after, source=source)
    goes_on = f", and goes on for {after:g} s" if after else ""
    _print_replies(
        replies, lambda take: f"take {take.name!r} is saved: {take.facts}{goes_on}", as_json=as_json
    )


@app.command()
def fetch(
    name: Annotated[
        str, typer.Argument(metavar="NAME", callback=checked_take_name, help="The name of the take.")
    ],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A new file, or a folder; the default is NAME.lcmlog here."),
    ] = None,
    source: SourceOption = None,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    prefix: PrefixOption = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for each piece.")] = 10.0,
    quiet: NoProgressOption = False,
) -> None:
    """Copy a take from a running gateway, over Zenoh. Of one that is running, copy what there is.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from gateway.cli.export_progress import file_progress
    from gateway.cli.main import exit_with
    from gateway.cli.take_list import size_text
    from gateway.client.client import GatewayAddress, GatewayClient
    from gateway.errors import QueryError
    from gateway.takes.files.new_file import NewFiles
    from gateway.takes.files.reader import SUFFIX

    address = GatewayAddress(connect=connect, zenoh_config=zenoh_config, prefix=prefix)
    log = f"{name}{SUFFIX}"
    path = Path(log) if file is None else file / log if file.is_dir() else file
    try:
        with NewFiles() as files:
            copy = files.create(path)  # before a long transfer: the file may exist already
            with (
                GatewayClient(address, timeout) as client,
                file_progress(f"fetching {name}", quiet=quiet) as progress,
            ):
                fetched = client.fetch_take(name, copy, source=source, progress=progress)
    except QueryError as error:
        exit_with([error])
        return
    what = f"{size_text(fetched.num_bytes)} of take {name!r} of source {fetched.source!r}"
    what = what if fetched.is_complete else f"the first {what}, which is still running"
    print(safe_text(f"{path}: {what}"))


@app.command("list")
@with_options
def list_(
    *,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    query: QueryOptions,
) -> None:
    """List the takes of running gateways.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from rich.console import Console

    from gateway.cli.main import exit_with
    from gateway.cli.take_list import write_list

    with query.client(lcm=lcm) as client:
        replies = client.takes(source)
    if as_json:
        _print_json(replies.received)
    else:
        write_list(replies.received, Console(file=sys.stdout))
    exit_with(replies.problems)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="A recording (.lcmlog), or the folder of a saved one.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: NoProgressOption = False,
) -> None:
    """Show what a recording contains, and what is missing: gaps, restarts, damage.

    The exit status is 1 if there is no recording that can be read, if it was cut off, or if it lacks messages
    that found no room on the disk.
    """
    from rich.console import Console

    from gateway.cli.export_progress import file_progress
    from gateway.cli.take_report import statistics_json, write_report
    from gateway.takes.files.statistics import take_statistics

    with file_progress(f"reading {file.name}", quiet=quiet) as progress:
        statistics = take_statistics(file, progress)
    if as_json:
        _print_json(statistics_json(statistics))
    else:
        write_report(statistics, Console(file=sys.stdout))
    if statistics.was_cut_short:
        raise typer.Exit(1)


def _print_replies(replies: "TakeReplies", text: Callable[["ListedTake"], str], *, as_json: bool) -> None:
    """Print what gateways replied to a command. The exit status is 1 if one of the takes has a problem."""
    from gateway.cli.main import exit_with
    from gateway.cli.take_list import ListedTake

    takes = {source: ListedTake(content) for source, content in replies.received.items()}
    if as_json:
        _print_json(replies.received)
    else:
        for source, take in takes.items():
            print(safe_text(f"{source}: {text(take)}"))
    exit_with(replies.problems)
    if any(take.problem for take in takes.values()):
        raise typer.Exit(1)


def _print_json(content: Any) -> None:
    print(safe_json(json.dumps(content, indent=2, ensure_ascii=False)))
