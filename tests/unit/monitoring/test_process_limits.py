"""What the system refuses to the whole process: real failures to start a thread."""

import errno
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gateway.monitoring.process_limits import ProcessLimits
from gateway.outputs.send_thread import SendThread
from gateway.worker_thread import WorkerThread


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
    limits, sender, worker, made = ProcessLimits(), SendThread("test"), WorkerThread("test"), list[int]()
    assert limits.problems() == []
    with no_threads():
        assert sender.offer(lambda: made.append(1))
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
    sender.submit(lambda: made.append(4)).result(10)
    sender.submit(lambda: None).result(10)
    sender.close()
    assert {3, 4} <= {*made}
    assert 2 not in made
