"""Threads that the end of the program does not wait for, and processes that run a module of this package."""

import asyncio
import gc
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from gateway.workers import WorkerThread, module_environment, result_of
from tests.waiting import wait_until_async


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
    monkeypatch.setattr("gateway.workers._IDLE_S", 0.0)
    worker = WorkerThread("test")
    first = await worker.run(threading.current_thread)
    first.join(10)
    assert not first.is_alive()
    assert await worker.run(threading.current_thread) is not first


def test_the_program_ends_while_a_call_blocks() -> None:
    code = (
        "import threading; from gateway.workers import WorkerThread\n"
        "WorkerThread('test').submit(threading.Event().wait)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)


def test_modules_in_the_working_directory_are_not_used(tmp_path: Path) -> None:
    for name in ("gateway.py", "queue.py"):
        (tmp_path / name).write_text("raise ImportError('this is a program of the user')")
    command = [sys.executable, "-m", "gateway", "--version"]
    subprocess.run(command, cwd=tmp_path, env=module_environment(), check=True)
