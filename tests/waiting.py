"""Waiting in tests: for a condition, never for a time."""

import asyncio
import time
from collections.abc import Callable

_POLL_S = 0.005


def wait_until(condition: Callable[[], object], timeout_s: float = 10) -> None:
    """Return as soon as ``condition`` holds; raises AssertionError if it does not within ``timeout_s``."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        time.sleep(_POLL_S)


async def wait_until_async(condition: Callable[[], object], timeout_s: float = 10) -> None:
    """Return as soon as ``condition`` holds, letting the loop run; raises as ``wait_until`` does."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        await asyncio.sleep(_POLL_S)
