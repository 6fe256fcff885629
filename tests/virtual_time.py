"""An event loop whose clock jumps to the next timer, so that a test can go through hours without waiting."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, Final, TypeVar

_START_S: Final = 1000.0
_Result = TypeVar("_Result")


class _JumpingSelector(selectors.DefaultSelector):
    """A selector that never waits for a timer, but moves the clock forward by that time."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = _START_S

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(None if timeout is None else 0)
        if not ready and timeout is not None:
            self.now_s += max(0.0, timeout)
        return ready


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop for code that waits on timers only.

    The clock also jumps on while a socket or a thread has yet to answer. Code that waits for these with a
    time-out needs a real loop.
    """

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now_s


def run_in_virtual_time(test: Coroutine[Any, Any, _Result]) -> _Result:
    """Run a coroutine in a ``VirtualTimeLoop`` and return its result; loop.time() begins at 1000 s."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(test)
