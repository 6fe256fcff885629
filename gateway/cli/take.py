"""``rtc3d-gateway take``: what recordings contain, and recording in a gateway."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import (
    ConnectOption,
    NoProgressOption,
    NoteOption,
    PrefixOption,
    QueriesUrlOption,
    SessionOption,
    SourceOption,
    SubjectOption,
    UrlOption,
    ZenohConfigOption,
    checked_details,
    checked_take_name,
)
from gateway.logs.safe_text import safe_json

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
_TimeoutOption = Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for replies.")]


def start(
    name: _NameArgument = None,
    subject: SubjectOption = None,
    session: SessionOption = None,
    note: NoteOption = None,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Start a take in a running gateway. Needs takes.enabled and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from gateway.cli.take_gateway import gateway_address, start_take

    address = gateway_address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    start_take(address, name, checked_details(subject, session, note), as_json=as_json)


def stop(
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Stop the running take.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else, also a take that lacks messages.
    """
    from gateway.cli.take_gateway import gateway_address, stop_take

    address = gateway_address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    stop_take(address, as_json=as_json)


def save(
    name: _NameArgument = None,
    last: Annotated[
        float | None,
        typer.Option(
            min=0.0, max=3600.0, help="How many of the last seconds; the default is all that are kept."
        ),
    ] = None,
    after: Annotated[float, typer.Option(min=0.0, max=3600.0, help="For how many seconds to go on.")] = 0.0,
    subject: SubjectOption = None,
    session: SessionOption = None,
    note: NoteOption = None,
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """Keep the last seconds as a take. Needs takes.keep_last_s and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from gateway.cli.take_gateway import gateway_address, save_take

    address = gateway_address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    save_take(address, name, last, after, checked_details(subject, session, note), as_json=as_json)


def list_(
    source: SourceOption = None,
    as_json: _JsonOption = False,
    lcm: _LcmOption = False,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    url: UrlOption = None,
    queries_url: QueriesUrlOption = None,
    prefix: PrefixOption = None,
    timeout: _TimeoutOption = 5.0,
) -> None:
    """List the takes of running gateways.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from gateway.cli.take_gateway import gateway_address, list_takes

    address = gateway_address(source, lcm, connect, zenoh_config, url, queries_url, prefix, timeout)
    list_takes(address, as_json=as_json)


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
    from gateway.cli.take_gateway import copy_take, gateway_address

    address = gateway_address(source, False, connect, zenoh_config, None, None, prefix, timeout)
    copy_take(address, name, file, quiet=quiet)


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to ``take``."""
    for command in (start, stop, save, fetch):
        app.command()(command)
    app.command("list")(list_)


app = typer.Typer(
    no_args_is_help=True, help="Inspect recordings (takes), and control those of running gateways."
)

add_commands(app)


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
        print(safe_json(json.dumps(statistics_json(statistics), indent=2, ensure_ascii=False)))
    else:
        write_report(statistics, Console(file=sys.stdout))
    if statistics.was_cut_short:
        raise typer.Exit(1)
