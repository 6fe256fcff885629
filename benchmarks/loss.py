"""How many messages of the dense workload Zenoh and LCM subscribers lose."""

from typing import Any, Final

from benchmarks.report import Goal, Progress, Table
from benchmarks.workbench import GATEWAY, Workbench
from benchmarks.workloads import DENSE

TITLE: Final = "Loss: the dense workload to 4 Zenoh and 4 LCM subscribers"
_EACH: Final = 4
_COMPONENTS: Final = 5


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return _seconds(quick) + 6


def _seconds(quick: bool) -> int:
    return 5 if quick else 60


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return how many messages were sent to each subscriber, and how many it received and lost."""
    seconds = _seconds(quick)
    progress.step(f"{seconds} s", 0)
    subscribers = [(1, 1)] * _EACH  # so Zenoh and LCM subscribers alternate below
    with Workbench(DENSE, subscribers=subscribers, reads=True, clients=(GATEWAY,)) as workbench:
        frames = round(seconds * DENSE.rate_hz)
        sent, cpu_s = workbench.pace(GATEWAY, frames, DENSE.rate_hz)
        workbench.settle(frames * _COMPONENTS)
        rows = [
            {
                "subscriber": f"{('Zenoh', 'LCM')[number % 2]} {number // 2 + 1}",
                "sent": frames * _COMPONENTS,
                "received": received.messages.total(),
                "lost": received.missing(sent.first, frames, _COMPONENTS),
            }
            for number, received in enumerate(workbench.take_received())
        ]
    return {
        "seconds": seconds,
        "sent_hz": round(frames / sent.took_s, 1),
        "cpu_share": cpu_s / sent.took_s,
        "rows": rows,
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    columns = ["subscriber", "messages sent", "received", "lost"]
    rows = [
        [row["subscriber"], *(str(row[name]) for name in ("sent", "received", "lost"))]
        for row in result["rows"]
    ]
    note = f"{result['seconds']} s at {result['sent_hz']:g} frames per second, five messages each."
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return how many messages all subscribers lost."""
    lost = sum(row["lost"] for row in result["rows"])
    sent = sum(row["sent"] for row in result["rows"])
    return [Goal(f"loss, dense, {result['seconds']} s", "none", f"{lost} of {sent}", lost == 0)]
