"""Threads that the end of the program does not wait for, and processes that run a module of this package."""

import asyncio
import gc
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from gateway.runtime.workers import (
    MAX_BYTES,
    MAX_CALLS,
    QueueRoom,
    WorkerThread,
    module_environment,
    result_of,
)
from tests.support.waiting import wait_until_async


@pytest.fixture
def blocked() -> Iterator[tuple[WorkerThread, threading.Event]]:
    """A thread that waits for the event."""
    worker, go, began = WorkerThread("blocked"), threading.Event(), threading.Event()

    def wait() -> None:
        began.set()
        go.wait(10)

    worker.submit(wait)
    assert began.wait(10)
    yield worker, go
    go.set()
    worker.close()


async def test_calls_are_made_in_their_order_in_another_thread() -> None:
    worker = WorkerThread("test")
    made: list[tuple[int, str]] = []
    for number in range(100):
        worker.submit(partial(lambda number: made.append((number, threading.current_thread().name)), number))
    assert await worker.run(lambda: len(made)) == 100
    assert made == [(number, "test") for number in range(100)]


async def test_the_exception_of_a_call_is_raised_and_later_calls_are_made() -> None:
    worker = WorkerThread("test")
    with pytest.raises(ZeroDivisionError):
        await worker.run(lambda: 1 // 0)
    assert await worker.run(lambda: "later") == "later"


async def test_a_thread_that_died_is_replaced_for_the_next_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without memory, an offered call raises MemoryError, and nothing was sent or answered after that."""
    worker = WorkerThread("test")
    reported = threading.Event()
    monkeypatch.setattr(
        threading, "excepthook", lambda _: reported.set()
    )  # pytest's own, maybe in the next test

    def fail() -> None:
        raise MemoryError

    assert worker.offer(fail)
    await asyncio.to_thread(reported.wait)
    assert not worker._is_running
    assert worker.call_age_s == 0
    assert await worker.run(lambda: "later") == "later"


async def test_the_age_of_a_call_is_that_of_the_one_in_progress() -> None:
    worker, begun, released = WorkerThread("test"), threading.Event(), threading.Event()

    def wait() -> None:
        begun.set()
        released.wait()

    assert worker.call_age_s == 0
    call = worker.submit(wait)
    begun.wait()
    age_s = worker.call_age_s
    assert 0 < age_s <= worker.call_age_s
    released.set()
    call.result()
    await worker.run(lambda: None)
    await wait_until_async(lambda: worker.call_age_s == 0)


def test_a_call_that_is_cancelled_before_its_turn_is_not_made(
    blocked: tuple[WorkerThread, threading.Event],
) -> None:
    worker, go = blocked
    made: list[str] = []
    cancelled = worker.submit(lambda: made.append("cancelled"))
    last = worker.submit(lambda: made.append("last"))
    cancelled.cancel()
    go.set()
    last.result(10)
    assert made == ["last"]


def test_offered_calls_are_made_in_order_after_those_that_must_be_made(
    blocked: tuple[WorkerThread, threading.Event],
) -> None:
    worker, go = blocked
    made: list[str] = []
    assert worker.offer(lambda: made.append("offered"))
    assert worker.offer(lambda: made.append("later"))
    worker.submit(lambda: made.append("submitted"))
    go.set()
    assert worker.finish(10)
    assert made == ["submitted", "offered", "later"]


def test_offered_calls_are_bounded_and_leave_room_when_they_are_made(
    blocked: tuple[WorkerThread, threading.Event],
) -> None:
    """A peer that does not read must not fill the memory."""
    worker, go = blocked
    assert worker.offer(lambda: None, MAX_BYTES + 1)  # a call of any size, alone
    assert not worker.offer(lambda: None)
    worker.submit(lambda: None)  # never refused
    go.set()
    made = threading.Event()
    worker.submit(made.set).result(10)
    while not worker.offer(lambda: None, MAX_BYTES):  # until the large one is made
        worker.submit(lambda: None).result(10)


def test_a_queue_has_room_for_some_calls_and_bytes() -> None:
    room = QueueRoom()
    assert [room.take(0) for _ in range(MAX_CALLS + 1)] == [True] * MAX_CALLS + [False]
    room.free(0)
    assert not room.take(MAX_BYTES + 1)
    assert room.take(MAX_BYTES)
    assert not room.take(1)
    room.free(MAX_BYTES)
    assert room.take(1)


def test_after_close_only_the_last_call_is_begun(blocked: tuple[WorkerThread, threading.Event]) -> None:
    """Nobody waits for ever for a call that was still queued, or came later."""
    worker, go = blocked
    made: list[str] = []
    ended = threading.Event()
    queued = worker.submit(lambda: made.append("queued"))
    worker.offer(lambda: made.append("offered"))
    worker.close(lambda: made.append("last"))
    worker.close(ended.set)
    later = worker.submit(lambda: made.append("later"))
    assert not worker.offer(lambda: made.append("refused"))
    go.set()
    assert worker.finish(10)
    assert (made, queued.cancelled(), later.cancelled()) == (["last"], True, True)
    assert not ended.is_set()


def test_what_takes_too_long_at_the_end_is_dropped(blocked: tuple[WorkerThread, threading.Event]) -> None:
    worker, go = blocked
    made: list[str] = []
    queued = worker.submit(lambda: made.append("queued"))
    worker.offer(lambda: made.append("offered"))
    assert not worker.finish(0)
    go.set()
    assert worker.finish(10)
    assert (made, queued.cancelled(), worker.submit(lambda: None).cancelled()) == ([], True, True)


@pytest.mark.parametrize("gives_up", [True, False])
async def test_an_error_after_the_caller_has_given_up_is_no_defect(gives_up: bool) -> None:
    released = threading.Event()
    unhandled: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: unhandled.append(context))

    def fail() -> None:
        released.wait()
        raise OSError("late")

    worker = WorkerThread("test")
    waiting = asyncio.create_task(result_of(worker.submit(fail)))
    await asyncio.sleep(0)
    if gives_up:
        waiting.cancel()
    released.set()
    with pytest.raises(asyncio.CancelledError if gives_up else OSError):
        await waiting
    await worker.run(lambda: None)
    del waiting
    gc.collect()  # asyncio reports an exception that nobody has retrieved when its future is freed
    assert unhandled == []


async def test_an_idle_thread_ends_and_the_next_call_starts_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of outputs and sources have a thread each, which most of them need once."""
    monkeypatch.setattr("gateway.runtime.workers._IDLE_S", 0.0)
    worker = WorkerThread("test")
    first = await worker.run(threading.current_thread)
    first.join(10)
    assert not first.is_alive()
    assert await worker.run(threading.current_thread) is not first


def test_the_program_ends_while_a_call_blocks() -> None:
    code = (
        "import threading; from gateway.runtime.workers import WorkerThread\n"
        "WorkerThread('test').submit(threading.Event().wait)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


def test_modules_in_the_working_directory_are_not_used(tmp_path: Path) -> None:
    for name in ("gateway.py", "queue.py"):
        (tmp_path / name).write_text("raise ImportError('this is a program of the user')")
    command = [sys.executable, "-m", "gateway", "--version"]
    subprocess.run(command, cwd=tmp_path, env=module_environment(), check=True)
