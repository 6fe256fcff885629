"""Clocks that tests set, and an event loop with virtual time."""

import asyncio
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar


class Clock:
    """Returns ``now_s`` when it is called."""

    def __init__(self, now_s: float = 1000.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


EPOCH_UTIME = 1_700_000_000_000_000

STEP_S = 0.01
_MAX_STEPS = 10_000

_Result = TypeVar("_Result")


class _JumpingSelector(selectors.DefaultSelector):
    """Never waits. When the loop would wait, time jumps to the next timer."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 1000.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if not ready:
            if timeout is None:
                raise AssertionError("no task is ready and no timer is set: the test would never end")
            self.now_s += max(0.0, timeout)
        return ready


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """An event loop for tests without sockets and threads."""

    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now_s

    def stop_process(self, seconds: float) -> None:
        """Let time pass as while the process is stopped: no timer is called, and no socket is read."""
        self._jumping.now_s += seconds


def run_in_virtual_time(test: Coroutine[Any, Any, _Result]) -> _Result:
    """Run a coroutine in a VirtualTimeLoop, and return its result; loop.time() begins at 1000 s."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(test)


def stop_process(seconds: float) -> None:
    """Stop the process in virtual time; see VirtualTimeLoop."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    loop.stop_process(seconds)


def read_clocks() -> tuple[int, int]:
    """Return the virtual time as HostClock.read does; the steady clock began at EPOCH_UTIME."""
    steady_us = round(1e6 * asyncio.get_running_loop().time())
    return EPOCH_UTIME + steady_us, steady_us


async def settle() -> None:
    """Run everything that is ready now."""
    for _ in range(20):
        await asyncio.sleep(0)


async def until(condition: Callable[[], Any]) -> None:
    """Let virtual time pass, in steps of 10 ms, until ``condition`` holds."""
    for _ in range(_MAX_STEPS):
        if condition():
            return
        await asyncio.sleep(STEP_S)
    raise AssertionError(f"still not true after {_MAX_STEPS * STEP_S:g} s of virtual time")
