"""The time and the rate of replies from the cache while the lab workload streams."""

import threading
import time
from collections.abc import Iterator
from typing import Any, Final

from benchmarks.processes import Worker
from benchmarks.report import Goal, Progress, Table, percentile
from benchmarks.subscribers import Received
from benchmarks.workbench import GATEWAY, Lab
from gateway.outputs.zenoh.subscriber import open_zenoh

TITLE: Final = "Queries for parameters, answered from the cache while the lab workload streams"
GOAL_MS: Final = 2.0
QUERIES_HZ: Final = 200
_KEY: Final = f"mocap/{GATEWAY}/parameters"
_WAIT_S: Final = 5.0


def send_queries(endpoint: str, seconds: float) -> Iterator[Any]:
    """Send queries in a Worker.

    On the first request, send queries at a fixed rate without waiting; yield the time to each reply in ms.
    On the second, send each query after the reply to the last one; yield the replies per second.
    """
    with open_zenoh(endpoint) as session:
        while not any(reply.ok is not None for reply in session.get(_KEY, timeout=_WAIT_S)):
            time.sleep(0.1)
        yield None
        yield _paced(session, round(seconds * QUERIES_HZ))
        count, began_s = 0, time.perf_counter()
        while time.perf_counter() - began_s < seconds / 2:
            count += sum(reply.ok is not None for reply in session.get(_KEY, timeout=_WAIT_S))
        yield count / (time.perf_counter() - began_s)


def _paced(session: Any, count: int) -> list[float]:
    reply_ms: list[float] = []
    replied = threading.Semaphore(0)

    def send_query() -> None:
        sent_s = time.perf_counter()

        def on_reply(reply: Any) -> None:
            if reply.ok is not None:
                reply_ms.append(1000 * (time.perf_counter() - sent_s))
            replied.release()

        session.get(_KEY, on_reply, timeout=_WAIT_S)

    start_s = time.perf_counter()
    for number in range(count):
        time.sleep(max(0.0, start_s + number / QUERIES_HZ - time.perf_counter()))
        send_query()
    for _ in range(count):
        replied.acquire(timeout=_WAIT_S)
    return reply_ms


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return _seconds(quick) * 1.5 + 5


def _seconds(quick: bool) -> float:
    return 2.0 if quick else 10.0


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the times to the replies, their rate, and how many messages of the stream were lost."""
    seconds = _seconds(quick)
    progress.step(f"{1.5 * seconds:g} s", 0)
    with Lab(reads=True) as lab, Worker(send_queries, lab.endpoint, seconds) as client:
        lab.take_received()
        reply_ms: list[float] = client.ask("paced")
        rate_hz: float = client.ask("one after another")
        lost = [num_gaps(received) for received in lab.take_received()]
    return {
        "asked": round(seconds * QUERIES_HZ),
        "answered": len(reply_ms),
        "ms": {f"p{each:g}": round(percentile(reply_ms, each), 3) for each in (50, 99, 99.9)},
        "answers_per_s": round(rate_hz),
        "lost": sum(lost),
    }


def num_gaps(received: Received) -> int:
    """Return how many frame numbers are missing between the first and the last of all topics but events."""
    topics = [topic for topic in received.numbers if not topic.lower().endswith("event")]
    return sum(1 + max(n) - min(n) - len(set(n)) for n in (received.numbers[topic] for topic in topics))


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = [
        [f"replies to {result['asked']} queries, {QUERIES_HZ} per second", str(result["answered"])],
        *([f"time to reply, {name}", f"{ms:.2f} ms"] for name, ms in result["ms"].items()),
        ["replies per second, one query after another", str(result["answers_per_s"])],
        ["messages of the stream lost meanwhile", str(result["lost"])],
    ]
    return [Table(TITLE, ["what", "measured"], rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the median time, and whether all queries were answered and nothing was lost."""
    reached = result["asked"] == result["answered"] and not result["lost"] and result["ms"]["p50"] < GOAL_MS
    unanswered = result["asked"] - result["answered"]
    measured = f"{result['ms']['p50']:.2f} ms; {unanswered} without reply, {result['lost']} lost"
    return [
        Goal("time to reply from the cache, p50", f"below {GOAL_MS:g} ms, nothing lost", measured, reached)
    ]
