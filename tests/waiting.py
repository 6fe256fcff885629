"""Waiting for conditions in tests."""

import asyncio
import time
from collections.abc import Callable

_POLL_S = 0.005


def wait_until(condition: Callable[[], object], timeout_s: float = 10) -> None:
    """Wait until ``condition`` holds; raises AssertionError after ``timeout_s``."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        time.sleep(_POLL_S)


async def wait_until_async(condition: Callable[[], object], timeout_s: float = 10) -> None:
    """Wait until ``condition`` holds while the event loop runs; raises as ``wait_until`` does."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"still not true after {timeout_s:g} s")
        await asyncio.sleep(_POLL_S)
