"""``rtc3d-gateway take``: what recordings contain, and recording in a gateway."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import NoProgressOption
from gateway.cli.take_control import add_commands
from gateway.safe_text import safe_json

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

    from gateway.cli.file_progress import file_progress
    from gateway.cli.take_json import statistics_json
    from gateway.cli.take_report import write_report
    from gateway.takes.statistics import take_statistics

    with file_progress(f"reading {file.name}", quiet=quiet) as progress:
        statistics = take_statistics(file, progress)
    if as_json:
        print(safe_json(json.dumps(statistics_json(statistics), indent=2, ensure_ascii=False)))
    else:
        write_report(statistics, Console(file=sys.stdout))
    if statistics.was_cut_short:
        raise typer.Exit(1)
