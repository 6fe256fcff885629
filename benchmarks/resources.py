"""The gateway's CPU use, its peak memory, and its memory over ten minutes."""

import time
from typing import Any, Final

from benchmarks.processes import cpu_s, memory_bytes, peak_memory_bytes
from benchmarks.report import Goal, Progress, Table
from benchmarks.workbench import GATEWAY, Lab, Workbench
from benchmarks.workloads import DENSE, Paced

TITLE: Final = "CPU and memory of the gateway, with one Zenoh subscriber and one LCM subscriber"
GOAL_MIB: Final = 2.0
_SETTLE_S: Final = 20.0
"""The wait before the first measurement, in which buffers grow to their final size."""


def _plan(quick: bool) -> tuple[int, float, float]:
    """Return the number of memory readings, their interval in s, and the wait before them in s."""
    return (2, 4.0, 1.0) if quick else (10, 60.0, _SETTLE_S)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    times, period_s, settling_s = _plan(quick)
    return times * period_s + settling_s + 8


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the results of two gateways that run at the same time, one per workload."""
    times, period_s, settling_s = _plan(quick)
    progress.step("waiting for buffers to grow", 0)
    with Lab() as lab, Workbench(DENSE, subscribers=[(1, 1)], clients=(GATEWAY,)) as workbench:
        pids = {"lab": lab.gateway.pid, "dense": workbench.programs[GATEWAY].pid}
        lasting_s = settling_s + times * period_s + 2
        workbench.sender.send(Paced(GATEWAY, round(lasting_s * DENSE.rate_hz), DENSE.rate_hz))
        time.sleep(settling_s)
        began_s = time.monotonic()
        cpu_before_s = {name: cpu_s(pid) for name, pid in pids.items()}
        memory: dict[str, list[int]] = {name: [memory_bytes(pid)] for name, pid in pids.items()}
        for number in range(1, times + 1):
            progress.step(f"{period_s:g} s, {number} of {times}", (number - 1) / times)
            time.sleep(max(0.0, began_s + number * period_s - time.monotonic()))
            for name, pid in pids.items():
                memory[name].append(memory_bytes(pid))
        took_s = time.monotonic() - began_s
        rows = {
            name: {
                "cpu_share": round((cpu_s(pid) - cpu_before_s[name]) / took_s, 4),
                "peak_bytes": peak_memory_bytes(pid),
                "memory_bytes": memory[name],
            }
            for name, pid in pids.items()
        }
        workbench.sender.reply()
    return {"period_s": period_s, "rows": rows}


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = [
        [
            name,
            f"{row['cpu_share']:.1%}",
            f"{_mib(row['peak_bytes']):.1f}",
            f"{_mib(_growth_bytes(row)):.2f}",
            " ".join(f"{_mib(each):.1f}" for each in row["memory_bytes"]),
        ]
        for name, row in result["rows"].items()
    ]
    columns = ["workload", "CPU of one core", "peak memory, MiB", "largest − smallest, MiB"]
    return [Table(TITLE, [*columns, f"memory every {result['period_s']:g} s, MiB"], rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return how much the memory varied."""
    most_mib = max(_mib(_growth_bytes(row)) for row in result["rows"].values())
    minutes = result["period_s"] * (len(result["rows"]["lab"]["memory_bytes"]) - 1) / 60
    what = f"memory over {minutes:.1g} minutes" if minutes < 1 else f"memory over {minutes:g} minutes"
    return [Goal(what, f"flat within {GOAL_MIB:g} MiB", f"within {most_mib:.2f} MiB", most_mib <= GOAL_MIB)]


def _growth_bytes(row: dict[str, Any]) -> int:
    sizes: list[int] = row["memory_bytes"]
    return max(sizes) - min(sizes)


def _mib(size_bytes: float) -> float:
    return size_bytes / 2**20
