"""A progress bar on stderr for commands that read long files."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from gateway.safe_text import safe_text


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
