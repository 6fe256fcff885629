"""Waiting for conditions in tests."""

import asyncio
import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

_TIMEOUT_S: Final = 60.0
"""What a test waits for takes much less. Only what hangs takes so long, on any computer."""

_POLL_S: Final = 0.005


def wait_until(condition: Callable[[], object], timeout_s: float = _TIMEOUT_S) -> None:
    """Wait until ``condition`` holds; raises AssertionError after ``timeout_s``."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        time.sleep(_POLL_S)


async def wait_until_async(condition: Callable[[], object], timeout_s: float = _TIMEOUT_S) -> None:
    """Wait until ``condition`` holds while the event loop runs; raises as ``wait_until`` does."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        await asyncio.sleep(_POLL_S)


def num_bytes_below(folder: Path) -> int:
    """Return the size of all files below a folder, where files are renamed and deleted meanwhile."""
    num_bytes = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            num_bytes += path.stat().st_size if path.is_file() else 0
    return num_bytes
