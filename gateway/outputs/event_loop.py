"""Calls from an output's threads into the gateway's event loop."""

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any


def in_this_loop(call: Callable[..., None]) -> Callable[..., None]:
    """Return a function for any thread that has ``call`` made in the event loop that runs now."""
    loop = asyncio.get_running_loop()

    def call_soon(*arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: the gateway has ended
            loop.call_soon_threadsafe(call, *arguments)

    return call_soon
