"""Part 7: answers from the cache while the lab workload streams: how long they take, how many there are."""

import threading
import time
from collections.abc import Iterator
from typing import Any, Final

from benchmarks.comparing import percentile
from benchmarks.lab import Lab
from benchmarks.processes import Worker
from benchmarks.report import Goal, Progress, Table
from benchmarks.stage import GATEWAY
from benchmarks.subscribers import Heard
from gateway.outputs.zenoh.subscriber import open_zenoh

TITLE: Final = "Queries: parameters from the gateway's cache, while the lab workload streams"
GOAL_MS: Final = 2.0
QUERIES_HZ: Final = 200
_KEY: Final = f"mocap/{GATEWAY}/parameters"
_WAIT_S: Final = 5.0


def ask(endpoint: str, seconds: float) -> Iterator[Any]:
    """Work of a Worker: ask at a steady pace whether answers have come or not, then one after the other.

    The first request gives how long each answer took, ms; the second how many came per second.
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
    took_ms: list[float] = []
    came = threading.Semaphore(0)

    def ask_once() -> None:
        asked_s = time.perf_counter()

        def take(reply: Any) -> None:
            if reply.ok is not None:
                took_ms.append(1000 * (time.perf_counter() - asked_s))
            came.release()

        session.get(_KEY, take, timeout=_WAIT_S)

    start_s = time.perf_counter()
    for number in range(count):
        time.sleep(max(0.0, start_s + number / QUERIES_HZ - time.perf_counter()))
        ask_once()
    for _ in range(count):
        came.acquire(timeout=_WAIT_S)
    return took_ms


def expected_s(quick: bool) -> float:
    """Return about how long it takes."""
    return _seconds(quick) * 1.5 + 5


def _seconds(quick: bool) -> float:
    return 2.0 if quick else 10.0


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the times of the answers, their rate, and what the stream's subscribers lost meanwhile."""
    seconds = _seconds(quick)
    progress.step(f"{1.5 * seconds:g} s", 0)
    with Lab(reads=True) as lab, Worker(ask, lab.endpoint, seconds) as asker:
        lab.take()
        took_ms: list[float] = asker.ask("paced")
        rate_hz: float = asker.ask("one after the other")
        lost = [_gaps(heard) for heard in lab.take()]
    return {
        "asked": round(seconds * QUERIES_HZ),
        "answered": len(took_ms),
        "ms": {f"p{each:g}": round(percentile(took_ms, each), 3) for each in (50, 99, 99.9)},
        "answers_per_s": round(rate_hz),
        "lost": sum(lost),
    }


def _gaps(heard: Heard) -> int:
    """Return how many frame numbers are missing between the first and the last of each topic of frames."""
    topics = [topic for topic in heard.numbers if not topic.lower().endswith("event")]
    return sum(1 + max(n) - min(n) - len(set(n)) for n in (heard.numbers[topic] for topic in topics))


def tables(result: dict[str, Any]) -> list[Table]:
    """Return what is shown of the figures."""
    rows = [
        [f"answers to {result['asked']} questions, {QUERIES_HZ} per second", str(result["answered"])],
        *([f"time to the answer, {name}", f"{ms:.2f} ms"] for name, ms in result["ms"].items()),
        ["answers per second, one after the other", str(result["answers_per_s"])],
        ["messages of the stream lost meanwhile", str(result["lost"])],
    ]
    return [Table(TITLE, ["what", "measured"], rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the median, and whether all were answered and nothing was lost."""
    fine = result["asked"] == result["answered"] and not result["lost"] and result["ms"]["p50"] < GOAL_MS
    unanswered = result["asked"] - result["answered"]
    found = f"{result['ms']['p50']:.2f} ms; {unanswered} without answer, {result['lost']} lost"
    return [
        Goal("answer from the cache, p50, and the stream", f"below {GOAL_MS:g} ms, nothing lost", found, fine)
    ]
