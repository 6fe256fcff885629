"""What commands show on a terminal while they read or write a take."""

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


@contextlib.contextmanager
def export_progress(*, quiet: bool = False) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar of one step after the other; yield a function that shows how far a step is.

    It takes what is done, how much of it, and how much there is; 0 is unknown. The bar is shown as that of
    ``file_progress``.
    """
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeRemainingColumn())
    disable = quiet or not sys.stderr.isatty()
    with Progress(*columns, console=console, transient=True, disable=disable) as bar:
        tasks: dict[str, TaskID] = {}  # the present one

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                for task in tasks.values():
                    bar.remove_task(task)
                tasks.clear()
                tasks[what] = bar.add_task(safe_text(what), total=total or None)
            bar.update(tasks[what], completed=done, total=total or None)

        yield show
