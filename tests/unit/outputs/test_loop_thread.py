"""Calls from threads into an event loop, and the thread that runs one."""

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError

import pytest

from gateway.outputs.frame_output import LoopThread, in_this_loop
from gateway.runtime.workers import MAX_BYTES


async def nothing() -> None: ...


def test_calls_are_made_in_order_in_the_thread() -> None:
    thread = LoopThread("test")
    made: list[tuple[int, str]] = []
    for number in range(100):
        assert thread.offer(lambda number=number: made.append((number, threading.current_thread().name)))  # type: ignore[misc]
    thread.run(nothing()).result(5)
    assert made == [(number, "test") for number in range(100)]
    thread.close(nothing, 5)


def test_the_queue_is_bounded() -> None:
    thread = LoopThread("test")
    entered, go_on = threading.Event(), threading.Event()

    def wait() -> None:
        entered.set()
        go_on.wait()

    thread.offer(wait)
    assert entered.wait(30)
    made: list[int] = []
    assert thread.offer(lambda: made.append(0), MAX_BYTES + 1)  # of any size, because the queue is empty
    assert not thread.offer(lambda: made.append(1), 1)
    go_on.set()
    thread.run(nothing()).result(5)
    assert thread.offer(lambda: made.append(2), MAX_BYTES)
    thread.run(nothing()).result(5)
    assert made == [0, 2]
    thread.close(nothing, 5)


def test_a_call_that_raises_is_logged_and_the_next_one_is_made(caplog: pytest.LogCaptureFixture) -> None:
    thread = LoopThread("test")
    made = threading.Event()

    def fail() -> None:
        raise ValueError("a defect")

    thread.offer(fail)
    thread.offer(made.set)
    assert made.wait(30)
    thread.close(nothing, 5)
    [record] = caplog.records
    assert record.levelno == logging.ERROR


def test_a_coroutine_that_raises_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    thread = LoopThread("test")

    async def fail() -> None:
        raise ValueError("a defect")

    async def fail_at_the_end() -> None:
        raise ValueError("another defect")

    assert isinstance(thread.run(fail()).exception(5), ValueError)
    thread.close(fail_at_the_end, 5)
    assert [record.levelno for record in caplog.records] == [logging.ERROR] * 2


def test_closing_awaits_the_last_coroutine_and_refuses_what_comes_later() -> None:
    thread = LoopThread("test")
    ended: list[str] = []

    async def last() -> None:
        await asyncio.sleep(0)
        ended.append("last")

    thread.close(last, 5)
    thread.close(last, 5)
    assert ended == ["last"]
    assert not thread.offer(lambda: None)
    with pytest.raises(CancelledError):
        thread.run(nothing()).result(5)


def test_closing_waits_no_longer_than_it_may() -> None:
    thread = LoopThread("test")
    go_on = threading.Event()

    def wait() -> None:
        go_on.wait()

    thread.offer(wait)
    thread.close(nothing, 0.01)
    go_on.set()


def test_closing_lets_tasks_finish_and_cancels_those_that_do_not() -> None:
    thread = LoopThread("test")
    finished: list[str] = []

    async def quick() -> None:
        await asyncio.sleep(0.01)
        finished.append("quick")

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            finished.append("endless")

    thread.run(quick())
    cancelled = thread.run(endless())
    thread.close(nothing, 5)
    assert finished == ["quick", "endless"]
    assert cancelled.cancelled()


async def test_a_call_of_another_thread_is_made_in_the_loop() -> None:
    made: asyncio.Future[tuple[int, threading.Thread]] = asyncio.get_running_loop().create_future()
    call = in_this_loop(lambda number: made.set_result((number, threading.current_thread())))
    await asyncio.to_thread(call, 7)
    assert await made == (7, threading.current_thread())


def test_calls_after_the_end_of_the_loop_do_nothing() -> None:
    made: list[None] = []

    async def begin() -> Callable[[], None]:
        return in_this_loop(lambda: made.append(None))

    call = asyncio.run(begin())
    call()
    assert made == []
