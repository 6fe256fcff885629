"""What may stop the gateway: a late event loop, threads that the system refuses, certificates, full disks.

OpenSSL made the certificates, and printed their ends.
"""

import asyncio
import errno
import resource
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring import process_limits
from gateway.daemon.monitoring.process_limits import DiskFacts, LoopDelay, ProcessLimits, return_free_memory
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.runtime.workers import WorkerThread
from tests.support.configurations import make_settings
from tests.support.errors import names
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


KEPT_BY_MALLOC = """
import resource
from pathlib import Path
from gateway.daemon.monitoring.process_limits import limit_kept_memory

def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

limit_kept_memory()
before = resident_bytes()
for size in (10_000_000, 9_000_000):
    bytes(b"x" * size)
print(resident_bytes() - before)
"""


def test_large_blocks_are_returned_when_they_are_freed() -> None:
    """Without a limit, glibc keeps the second one: the first one has raised its threshold."""
    assert int(subprocess.check_output([sys.executable, "-c", KEPT_BY_MALLOC])) < 2_000_000


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
    assert names(problem, "thread", "4 attempts", "TasksMax")
    assert "TasksMax" in problem
    assert len(caplog.records) == 1
    assert limits.problems() == []
    worker.submit(lambda: made.append(3)).result(10)
    assert worker.finish(10)
    assert made == [3, 1]


FOLDER = Path(__file__).parents[3] / "data/certificates"
NEAR_S, FAR_S = 1925048779, 3005048779  # one before 2050 and one after, whose times have two forms


async def facts_of(until: str, **outputs: Any) -> DiskFacts:
    """Return the facts of a gateway with these settings of outputs as soon as ``until`` is known."""
    source = SourceSettings(name="lab", host="192.0.2.20")
    facts = DiskFacts(Gateway(make_settings(sources=(source,), **outputs), []))
    facts.start()
    await wait_until_async(lambda: getattr(facts, until))
    facts.close()
    return facts


def tls(**files: Path) -> ZenohSettings:
    keys = {key: str(path) for key, path in files.items()}
    return ZenohSettings(config={"transport": {"link": {"tls": keys}}})


async def test_the_end_of_each_certificate_of_zenoh_is_read(tmp_path: Path) -> None:
    """Zenoh closes a link when its certificate ends, and nobody expects it on that day."""
    both = tmp_path / "chain.crt"
    both.write_text((FOLDER / "far.crt").read_text() + "# the issuer\n" + (FOLDER / "near.crt").read_text())
    (tmp_path / "damaged.crt").write_text((FOLDER / "near.crt").read_text()[:300])
    facts = await facts_of(
        "certificate_ends_s",
        zenoh=tls(
            connect_certificate=FOLDER / "far.crt", root_ca_certificate=both, listen_certificate=tmp_path
        ),
    )
    assert facts.certificate_ends_s == {
        ("zenoh", "connect_certificate"): FAR_S,
        ("zenoh", "root_ca_certificate"): NEAR_S,  # the first to end
    }


@pytest.mark.parametrize("name", ["near", "far"])
def test_a_damaged_certificate_raises_only_the_documented_error(name: str) -> None:
    """What is in a file must not end the thread, or the page of the metrics."""
    der = ssl.PEM_cert_to_DER_cert((FOLDER / f"{name}.crt").read_text())
    assert process_limits._end_s(der) in {NEAR_S, FAR_S}
    for position in range(len(der)):
        for damaged in (der[:position], der[:position] + b"\xff" + der[position + 1 :]):
            try:
                process_limits._end_s(damaged)
            except ValueError:
                continue


async def test_the_room_for_takes_is_that_of_their_disk(tmp_path: Path) -> None:
    """A disk that fills up is to be noticed before takes are lost."""
    facts = await facts_of("takes_free_bytes", takes=TakesSettings(enabled=True, directory=str(tmp_path)))
    assert facts.takes_free_bytes is not None
    assert facts.takes_free_bytes > 0
    assert facts.certificate_ends_s == {}
