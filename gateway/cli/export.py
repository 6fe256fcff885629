"""``rtc3d-gateway export``: convert a take to a file of another program."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import NoProgressOption, SourceOption
from gateway.config.words import join_or
from gateway.logs.safe_text import safe_text
from gateway.takes.export.job import FORMATS, ExportJob, export_take


def export(
    file: Annotated[Path, typer.Argument(help="The take: a recording (.lcmlog), or the folder of one.")],
    out: Annotated[
        Path, typer.Argument(help=f"The new file; its extension is the format: {join_or(FORMATS)}.")
    ],
    source: SourceOption = None,
    from_s: Annotated[
        float | None,
        typer.Option("--from", min=0, help="Where to begin, in s from the take's first message."),
    ] = None,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to", min=0, help="Where to end, in s from the first message; the default is its end."
        ),
    ] = None,
    quiet: NoProgressOption = False,
) -> None:
    """Convert a take to a file of another program, such as C3D; never overwrite a file."""
    if from_s is not None and to_s is not None and from_s >= to_s:
        raise typer.BadParameter(f"--from {from_s:g} is not before --to {to_s:g}")
    from gateway.cli.export_progress import export_progress

    job = ExportJob(file, out, source=source, from_s=from_s, to_s=to_s)
    with export_progress(quiet=quiet) as job.progress:
        paths = export_take(job)
    for note in job.notes:
        print(f"note: {safe_text(note)}", file=sys.stderr)
    for path in paths:
        print(f"{path} ({_size(path.stat().st_size)})")


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:.1f} MB" if num_bytes >= 100_000 else f"{num_bytes / 1e3:.1f} kB"
