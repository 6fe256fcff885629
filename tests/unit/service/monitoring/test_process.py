"""The gateway's own process: delays of its event loop, and threads that the system refuses."""

import asyncio
import errno
import resource
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.service.monitoring.process_limits import LoopDelay, ProcessLimits, return_free_memory
from gateway.workers import WorkerThread
from tests.support.waiting import wait_until_async


def test_the_largest_delay_expires_after_one_to_two_minutes() -> None:
    delay = LoopDelay()
    largest = []
    for now_s, delay_s in ((0.0, 0.0), (59.0, 0.5), (61.0, 0.1), (119.0, 0.2), (121.5, 0.0), (182.0, 0.0)):
        delay.record(now_s, delay_s)
        assert delay.last_s == delay_s
        largest.append(delay.max_s)
    assert largest == [0.0, 0.5, 0.5, 0.5, 0.2, 0.0]


async def test_a_blocked_event_loop_is_measured() -> None:
    delay = LoopDelay()
    delay.start()
    await asyncio.sleep(0)
    time.sleep(0.4)  # noqa: ASYNC251 - blocks the loop on purpose, between two measurements
    await wait_until_async(lambda: delay.max_s >= 0.2)
    delay.close()


async def test_closing_stops_the_measurement() -> None:
    delay = LoopDelay()
    delay.start()
    await wait_until_async(lambda: delay.last_s > 0)
    delay.close()
    assert delay._timer is not None
    assert delay._timer.cancelled()


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_memory_between_blocks_in_use_is_returned() -> None:
    """Without this, glibc keeps it until also the blocks around it are free."""
    blocks = [bytearray(10_000) for _ in range(8_000)]
    kept = blocks[::50]
    del blocks
    before = resident_bytes()
    return_free_memory()
    assert before - resident_bytes() > 40_000_000
    assert len(kept) == 160


@contextmanager
def no_threads() -> Iterator[None]:
    """Let no thread start: its stack does not fit into the address space."""
    before = threading.stack_size(1 << 47)
    try:
        yield
    finally:
        threading.stack_size(before)


def test_threads_that_do_not_start_are_told_until_one_starts(caplog: pytest.LogCaptureFixture) -> None:
    """What had to be done in them is done later, or whoever asked for it gets an error of the system."""
    limits, worker, made = ProcessLimits(), WorkerThread("test"), list[int]()
    assert limits.problems() == []
    with no_threads():
        assert worker.offer(lambda: made.append(1))
        with pytest.raises(OSError, match="can't start new thread") as refused:
            worker.submit(lambda: made.append(2)).result(10)
        assert refused.value.errno == errno.EAGAIN
        limits.problems()
        [problem] = limits.problems()
    assert "no further thread can be started beside the" in problem
    assert "(4 attempts failed)" in problem
    assert "TasksMax" in problem
    assert len(caplog.records) == 1
    assert limits.problems() == []
    worker.submit(lambda: made.append(3)).result(10)
    assert worker.finish(10)
    assert made == [3, 1]
