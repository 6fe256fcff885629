"""What ``export`` shows while it runs."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from gateway.logs.safe_text import safe_text


@contextlib.contextmanager
def file_progress(text: str, *, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar while the context is open; yield a function that takes bytes done and bytes in all.

    The bar is shown on a terminal only, unless ``quiet``, and disappears at the end.
    """
    console = Console(file=sys.stderr)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    disable = quiet or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=disable) as progress:
        task = progress.add_task(safe_text(text).replace("[", r"\["), total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


class ExportProgress:
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

    def __enter__(self) -> "ExportProgress":
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
