"""``rtc3d-gateway take`` and ``export``: what recordings contain, and recording in a gateway."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gateway.config.words import join_or
from gateway.errors import QueryError
from gateway.runtime.safe_text import safe_text
from gateway.takes.export.job import (
    Axis,
    BidsNames,
    ExportJob,
    OpenSimOptions,
    TakePart,
    export_take,
)
from gateway.takes.export.registry import FORMATS, UNUSABLE
from gateway.tools.cli import completion, options
from gateway.tools.cli.main import exit_with, print_json

if TYPE_CHECKING:
    from gateway.client.client import TakeReplies
    from gateway.tools.cli.take_report import ListedTake

app = typer.Typer(
    no_args_is_help=True, help="Inspect recordings (takes), and control those of running gateways."
)

_NameArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="NAME",
        callback=options.checked_take_name,
        help="The name of the take; the default is SOURCE-DATE-TIME.",
    ),
]
_JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@app.command()
@options.with_options
def start(
    name: _NameArgument = None,
    *,
    details: options.DetailsOptions,
    source: options.SourceOption = None,
    as_json: _JsonOption = False,
    lcm: options.LcmOption = False,
    query: options.QueryOptions,
) -> None:
    """Start a take in a running gateway. Needs takes.enabled and, for the source, remote_control.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    described = details.checked()
    with query.client(lcm=lcm) as client:
        replies = client.start_take(name, described, source=source)
    _print_replies(replies, lambda take: f"take {take.name!r} is running", as_json=as_json)


@app.command()
@options.with_options
def stop(
    *,
    source: options.SourceOption = None,
    as_json: _JsonOption = False,
    lcm: options.LcmOption = False,
    query: options.QueryOptions,
) -> None:
    """Stop the running take, and print how long it is.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else, also a take that lacks messages.
    """
    with query.client(lcm=lcm) as client:
        replies = client.stop_take(source=source)
    _print_replies(replies, lambda take: f"take {take.name!r} is stopped: {take.facts}", as_json=as_json)


@app.command()
@options.with_options
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
    details: options.DetailsOptions,
    source: options.SourceOption = None,
    as_json: _JsonOption = False,
    lcm: options.LcmOption = False,
    query: options.QueryOptions,
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
        str,
        typer.Argument(
            metavar="NAME",
            callback=options.checked_take_name,
            autocompletion=completion.take_names,
            help="The name of the take.",
        ),
    ],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="A new file, or a folder; the default is NAME.lcmlog here."),
    ] = None,
    source: options.SourceOption = None,
    connect: options.ConnectOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    prefix: options.PrefixOption = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for each piece.")] = 10.0,
    quiet: options.NoProgressOption = False,
) -> None:
    """Copy a take from a running gateway, over Zenoh. Of one that is running, copy what there is.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from gateway.client.client import GatewayAddress, GatewayClient
    from gateway.runtime.quantities import size_text
    from gateway.takes.files.new_file import NewFiles
    from gateway.takes.files.reader import SUFFIX

    address = GatewayAddress(connect=connect, zenoh_config=zenoh_config, prefix=prefix)
    log = f"{name}{SUFFIX}"
    path = Path(log) if file is None else file / log if file.is_dir() else file
    try:
        with NewFiles() as files:
            copy = files.create(path)  # before a long transfer: the file may exist already
            with GatewayClient(address, timeout) as client, progress_bar(quiet=quiet) as show:
                progress = partial(show, f"fetching {name}")
                progress(0, 0)  # until the first piece
                fetched = client.fetch_take(name, copy, source=source, progress=progress)
    except QueryError as error:
        exit_with([error])
        return
    what = f"{size_text(fetched.num_bytes)} of take {name!r} of source {fetched.source!r}"
    what = what if fetched.is_complete else f"the first {what}, which is still running"
    print(safe_text(f"{path}: {what}"))


@app.command("list")
@options.with_options
def list_(
    *,
    source: options.SourceOption = None,
    as_json: _JsonOption = False,
    lcm: options.LcmOption = False,
    query: options.QueryOptions,
) -> None:
    """List the takes of running gateways: when, how long, how large, what they lack and are about.

    Exit status 3: no gateway found; 5: no reply in time; 1: anything else.
    """
    from rich.console import Console

    from gateway.tools.cli.take_report import write_list

    with query.client(lcm=lcm) as client:
        replies = client.takes(source)
    if as_json:
        print_json(replies.received)
    else:
        write_list(replies.received, Console(file=sys.stdout))
    exit_with(replies.problems)


@app.command()
def info(
    file: Annotated[
        Path,
        typer.Argument(
            autocompletion=completion.take_files,
            help="A recording (.lcmlog), or the folder of a saved one.",
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    quiet: options.NoProgressOption = False,
) -> None:
    """Show what a recording contains, and what is missing: gaps, restarts, damage.

    The exit status is 1 if there is no recording that can be read, if it was cut off, or if it lacks messages
    that found no room on the disk.
    """
    from rich.console import Console

    from gateway.takes.files.statistics import take_statistics
    from gateway.tools.cli.take_report import statistics_json, write_report

    with progress_bar(quiet=quiet) as show:
        statistics = take_statistics(file, partial(show, f"reading {file.name}"))
    if as_json:
        print_json(statistics_json(statistics))
    else:
        write_report(statistics, Console(file=sys.stdout))
    if statistics.was_cut_short:
        raise typer.Exit(1)


def _print_replies(replies: "TakeReplies", text: Callable[["ListedTake"], str], *, as_json: bool) -> None:
    """Print what gateways replied to a command. The exit status is 1 if one of the takes has a problem."""
    from gateway.tools.cli.take_report import ListedTake

    takes = {source: ListedTake(content) for source, content in replies.received.items()}
    if as_json:
        print_json(replies.received)
    else:
        for source, take in takes.items():
            print(safe_text(f"{source}: {text(take)}"))
    exit_with(replies.problems)
    if any(take.problem for take in takes.values()):
        raise typer.Exit(1)


@options.with_options
def export(
    file: Annotated[
        Path,
        typer.Argument(
            autocompletion=completion.take_files,
            help="The take: a recording (.lcmlog), or the folder of one.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Argument(
            help="The new file; its extension is the format: "
            f"{join_or([*FORMATS, 'one of an installed package'])}. With --opensim or --bids, a folder."
        ),
    ],
    *,
    source: options.SourceOption = None,
    from_s: options.FromOption = None,
    to_s: options.ToOption = None,
    details: options.DetailsOptions,
    ros2: Annotated[bool, typer.Option("--ros2", help="Write a bag of ROS 2 (.mcap).")] = False,
    opensim: Annotated[
        bool,
        typer.Option(
            "--opensim",
            help="Write files for OpenSim to the folder OUT: markers, ground reactions, analog channels.",
        ),
    ] = False,
    up: Annotated[
        Axis | None,
        typer.Option(
            help="For OpenSim: the server's axis that points up, such as y or -z; "
            "the default is that of the plates, or z."
        ),
    ] = None,
    forward: Annotated[
        Axis | None,
        typer.Option(
            help="For OpenSim: the server's axis that becomes X; the default is x, or z if x points up."
        ),
    ] = None,
    min_force: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="For OpenSim: the force in N at which contact with a plate begins; the default is 10.",
        ),
    ] = None,
    bodies: Annotated[
        str | None,
        typer.Option(
            help="For --opensim: the model's body that steps on each plate, such as calcn_r,calcn_l."
        ),
    ] = None,
    bids: Annotated[
        bool,
        typer.Option("--bids", help="Add the take to a Motion-BIDS data set; OUT is its folder, new or not."),
    ] = False,
    task: Annotated[
        str | None, typer.Option(help="For --bids, which needs it: the task, such as walking.")
    ] = None,
    run: Annotated[
        int | None,
        typer.Option(
            min=1, help="For --bids: the number of the first run; the default is the next free one."
        ),
    ] = None,
    quiet: options.NoProgressOption = False,
) -> None:
    """Convert a take to the files of other programs, such as C3D; never overwrite a file.

    Subject, session and note are those of the take, unless options give others.
    """
    from rich.console import Console

    from gateway.runtime.quantities import size_text
    from gateway.tools.display.terminal import print_list

    if from_s is not None and to_s is not None and from_s >= to_s:
        raise typer.BadParameter(f"--from {from_s:g} is not before --to {to_s:g}")
    chosen = {"opensim": opensim, "bids": bids, "ros2": ros2}
    formats = [name for name, is_chosen in chosen.items() if is_chosen]
    if len(formats) > 1:
        raise typer.BadParameter(f"--{formats[0]} and --{formats[1]} are different formats; choose one")
    chosen_format = formats[0] if formats else ""
    kind = f"--{chosen_format}" if chosen_format else out.suffix.lower()
    names = BidsNames(task, run)
    for option, value, kinds in (
        ("--up", up, (".trc", ".mot", "--opensim")),
        ("--forward", forward, (".trc", ".mot", "--opensim")),
        ("--min-force", min_force, (".mot", "--opensim")),
        ("--bodies", bodies, ("--opensim",)),
        *((f"--{name}", value, ("--bids",)) for name, value in asdict(names).items()),
    ):
        if value is not None and kind not in kinds:
            raise typer.BadParameter(f"{option} is for {join_or(kinds)} only")
    bodies_of_plates = tuple(filter(None, map(str.strip, (bodies or "").split(","))))
    job = ExportJob(
        file,
        out,
        chosen_format,
        part=TakePart(source, from_s, to_s),
        details=details.given(),
        opensim=OpenSimOptions(up, forward, min_force, bodies_of_plates),
        bids=names,
    )
    with progress_bar(quiet=quiet, counts_bytes=False) as job.progress:
        paths = export_take(job)
    print_list(Console(stderr=True), ["file", "changed, rounded or left out", "how much"], job.notes)
    for path in paths:
        print(f"{path} ({size_text(path.stat().st_size)})")
    for text in UNUSABLE.values():
        print(f"note: {text}", file=sys.stderr)


@contextmanager
def progress_bar(*, quiet: bool, counts_bytes: bool = True) -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar on a terminal, unless ``quiet``, until the context ends; yield a function that moves it.

    It takes what is done, how much of it, and how much there is; 0 is unknown. Each step has its own bar.
    """
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr)
    amount = [DownloadColumn()] if counts_bytes else []
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), *amount, TimeRemainingColumn())
    is_hidden = quiet or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=is_hidden) as bar:

        def show(what: str, done: int, total: int) -> None:
            text = safe_text(what)
            if [task.description for task in bar.tasks] != [text]:
                for former in bar.task_ids:
                    bar.remove_task(former)
                bar.add_task(text, total=total or None)
            bar.update(bar.task_ids[0], completed=done, total=total or None)

        yield show
