import subprocess
import sys
import threading
from functools import partial

import pytest

from gateway.outputs import threads
from gateway.outputs.threads import SendThread
from tests.waiting import wait_until


@pytest.fixture
def blocked() -> tuple[SendThread, threading.Event]:
    """A sender whose thread waits for the event."""
    sender, go = SendThread("blocked"), threading.Event()
    began = threading.Event()

    def wait() -> None:
        began.set()
        go.wait(10)

    sender.submit(wait)
    assert began.wait(10)
    return sender, go


def test_calls_are_made_in_order_in_a_thread_of_its_own() -> None:
    sender = SendThread("test")
    made: list[tuple[int, str]] = []

    def call(number: int) -> None:
        made.append((number, threading.current_thread().name))

    futures = [sender.submit(partial(call, number)) for number in range(100)]
    for future in futures:
        future.result(10)
    assert made == [(number, "test") for number in range(100)]
    sender.close()


def test_the_age_of_a_call_is_known_while_it_is_made(blocked: tuple[SendThread, threading.Event]) -> None:
    sender, go = blocked
    assert sender.call_age_s > 0
    go.set()
    wait_until(lambda: sender.call_age_s == 0)


def test_what_a_call_raises_goes_to_who_waits_for_it_and_the_next_is_made() -> None:
    def fail() -> None:
        raise OSError("of the test")

    sender = SendThread("test")
    failed, good = sender.submit(fail), sender.submit(lambda: None)
    with pytest.raises(OSError, match="of the test"):
        failed.result(10)
    good.result(10)
    sender.close()


def test_a_call_that_is_cancelled_before_its_turn_is_not_made(
    blocked: tuple[SendThread, threading.Event],
) -> None:
    sender, go = blocked
    made: list[str] = []
    cancelled = sender.submit(lambda: made.append("cancelled"))
    last = sender.submit(lambda: made.append("last"))
    cancelled.cancel()
    go.set()
    last.result(10)
    assert made == ["last"]
    sender.close()


def test_after_close_no_call_is_begun(blocked: tuple[SendThread, threading.Event]) -> None:
    """Nobody waits for ever for one that was still queued, or came later."""
    sender, go = blocked
    made: list[str] = []
    queued = sender.submit(lambda: made.append("late"))
    # The thread of an earlier test may still be ending; the newest is the last.
    *_, thread = (each for each in threading.enumerate() if each.name == "blocked")
    sender.close()
    go.set()
    thread.join(10)
    assert not thread.is_alive()
    later = sender.submit(lambda: made.append("later"))
    assert (made, queued.cancelled(), later.cancelled()) == ([], True, True)


def test_the_end_of_the_program_does_not_wait_for_a_call() -> None:
    code = (
        "import threading; from gateway.outputs.threads import SendThread;"
        "began = threading.Event();"
        "SendThread('s').submit(lambda: (began.set(), threading.Event().wait())); began.wait()"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == 0


def test_offered_calls_are_made_after_those_that_must_be_made(
    blocked: tuple[SendThread, threading.Event],
) -> None:
    sender, go = blocked
    made: list[str] = []
    last = threading.Event()
    assert sender.offer(lambda: made.append("offered"))
    assert sender.offer(last.set)
    sender.submit(lambda: made.append("submitted"))
    go.set()
    assert last.wait(10)
    assert made == ["submitted", "offered"]
    sender.close()


def test_offered_calls_beyond_the_number_or_the_bytes_are_refused(
    blocked: tuple[SendThread, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "MAX_CALLS", 3)
    monkeypatch.setattr(threads, "MAX_BYTES", 100)
    sender, go = blocked
    made: list[int] = []
    last = threading.Event()
    assert sender.offer(lambda: made.append(1000), 1000)  # a call of any size, alone
    assert not sender.offer(lambda: made.append(1), 1)
    sender.submit(lambda: made.append(0))  # never refused
    go.set()
    sender.submit(lambda: None).result(10)
    wait_until(lambda: made == [0, 1000])
    assert sender.offer(last.set, 1)
    assert last.wait(10)
    sender.close()
    assert not sender.offer(lambda: None)


def test_the_number_of_offered_calls_is_limited(
    blocked: tuple[SendThread, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "MAX_CALLS", 3)
    sender, go = blocked
    assert [sender.offer(lambda: None) for _ in range(5)] == [True] * 3 + [False] * 2
    go.set()
    sender.close()
