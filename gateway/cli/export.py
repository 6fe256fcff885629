"""``rtc3d-gateway export``: convert a take to a file of another program."""

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from gateway.cli.options import SourceOption
from gateway.config.section import join_or
from gateway.export.formats import FORMATS, export_take
from gateway.export.job import ExportJob
from gateway.safe_text import safe_text


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
) -> None:
    """Convert a take to a file of another program, such as C3D; never overwrite a file."""
    job = ExportJob(file, out, source=source, from_s=from_s, to_s=to_s)
    with _Progress() if sys.stderr.isatty() else nullcontext() as progress:
        if progress is not None:
            job.progress = progress.show
        paths = export_take(job)
    for note in job.notes:
        print(f"note: {safe_text(note)}", file=sys.stderr)
    for path in paths:
        print(f"{path} ({_size(path.stat().st_size)})")


class _Progress:
    """A progress bar on stderr."""

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._task: TaskID | None = None
        self._what = ""

    def __enter__(self) -> "_Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, what: str, done: int, total: int) -> None:
        """Show what is being done, and how much of it; a ``total`` of 0 is unknown."""
        if self._task is None or what != self._what:
            if self._task is not None:
                self._bar.remove_task(self._task)
            self._task = self._bar.add_task(safe_text(what), total=total or None)
            self._what = what
        self._bar.update(self._task, completed=done, total=total or None)


def _size(num_bytes: int) -> str:
    return f"{num_bytes / 1e6:.1f} MB" if num_bytes >= 100_000 else f"{num_bytes / 1e3:.1f} kB"
