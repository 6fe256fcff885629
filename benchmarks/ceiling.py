"""The gateway and the bare relay at full speed: frames per second and CPU time per frame."""

from typing import Any, Final

from benchmarks.report import Goal, Pair, Progress, Table, table_cell
from benchmarks.workbench import GATEWAY, RELAY, Workbench
from benchmarks.workloads import DENSE

TITLE: Final = "Throughput: the gateway and the bare relay, as fast as TCP delivers frames"
GOAL: Final = 0.95

_OUTPUTS: Final = {"Zenoh": (True, False), "LCM": (False, True), "both": (True, True)}
_PER_PROCESS: Final = 4
_FIRST_FRAMES: Final = 2_000
_MIN_RELAY_LOAD: Final = 0.7
"""If the relay uses less of its core, the subscribers limit its throughput."""


def _cases(quick: bool) -> list[tuple[str, int, bool]]:
    counts = (0, 4) if quick else (0, 1, 4, 16)
    return [
        (output, count, routed)
        for output, (zenoh, _) in _OUTPUTS.items()
        for routed in ((False, True) if zenoh and not quick else (False,))
        for count in counts
    ]


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    return len(_cases(quick)) * (3 if quick else 24)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the frames per second and the CPU times of all pairs of runs, for each case."""
    lasting_s, pairs = (0.1, 2) if quick else (0.4, 15)
    cases = _cases(quick)
    rows = []
    for number, (output, count, routed) in enumerate(cases):
        progress.step(f"{output}, {count} subscribers{', routed' if routed else ''}", number / len(cases))
        rows.append(_case(output, count, routed, lasting_s, pairs))
    return {"rows": rows}


def _case(output: str, count: int, routed: bool, lasting_s: float, pairs: int) -> dict[str, Any]:
    zenoh, lcm = _OUTPUTS[output]
    in_processes = [
        (min(_PER_PROCESS, count - first) * zenoh, min(_PER_PROCESS, count - first) * lcm)
        for first in range(0, count, _PER_PROCESS)
    ]
    rates = Pair(GATEWAY, RELAY)
    costs_us = Pair(GATEWAY, RELAY)
    with Workbench(
        DENSE,
        zenoh=zenoh,
        lcm=lcm,
        subscribers=in_processes,
        routed=routed,
    ) as workbench:
        workbench.blast(GATEWAY, _FIRST_FRAMES)  # warms up
        sent, _ = workbench.blast(RELAY, _FIRST_FRAMES)
        frames = round(lasting_s * _FIRST_FRAMES / sent.took_s)
        for name in (GATEWAY, RELAY) * pairs:
            sent, cpu_s = workbench.blast(name, frames)
            rates.add(name, sent.frames / sent.took_s)
            costs_us.add(name, 1e6 * cpu_s / sent.frames)
    return {
        "output": output,
        "subscribers": count,
        "routed": routed,
        "frames": frames,
        "frames_per_s": rates.as_dict(),
        "cpu_us_per_frame": costs_us.as_dict(),
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = []
    for row in result["rows"]:
        rates, costs = Pair.of(row["frames_per_s"]), Pair.of(row["cpu_us_per_frame"])
        rows.append(
            [
                row["output"],
                "routed" if row["routed"] else "direct",
                str(row["subscribers"]),
                f"{rates.median(GATEWAY):.0f}",
                f"{rates.median(RELAY):.0f}",
                table_cell(rates),
                f"{costs.median(GATEWAY):.1f}",
                f"{costs.median(RELAY):.1f}",
                table_cell(costs),
                f"{_relay_load(row):.0%}",
            ]
        )
    columns = ["output", "connection", "subscribers", "gateway frames/s", "relay frames/s", "ratio"]
    columns += ["gateway CPU µs/frame", "relay CPU µs/frame", "ratio", "relay's core in use"]
    note = (
        f"If the relay uses less than {_MIN_RELAY_LOAD:.0%} of its core, the subscribers are the limit; "
        "the goal ignores these cases."
    )
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the worst and the median ratio of the cases in which the subscribers are not the limit."""
    relevant = [row for row in result["rows"] if _relay_load(row) >= _MIN_RELAY_LOAD] or result["rows"]
    ratios = sorted(Pair.of(row["frames_per_s"]).ratio for row in relevant)
    measured = (
        f"{ratios[0]:.2f} in the worst of {len(ratios)} cases, {ratios[len(ratios) // 2]:.2f} in the median"
    )
    return [Goal("throughput compared with the bare relay", f"at least {GOAL}", measured, ratios[0] >= GOAL)]


def _relay_load(row: dict[str, Any]) -> float:
    """Return the share of its core that the relay used, 0 to 1."""
    cost_us, rate = Pair.of(row["cpu_us_per_frame"]), Pair.of(row["frames_per_s"])
    return cost_us.median(RELAY) * rate.median(RELAY) / 1e6
