"""The CPU time per frame at real rates and at full speed: of the gateway and of bare relays.

The relays are measured beside the gateway, one after the other, again and again, so that a slow phase of the
machine concerns all of them. The native relay is the bare relay in Rust (Zenoh) or C (LCM).
"""

import math
import statistics
from typing import Any, Final

from benchmarks.processes import NATIVE_RELAYS
from benchmarks.report import Goal, Pair, Progress, Table, table_cell
from benchmarks.workbench import GATEWAY, NATIVE, RELAY, WITHOUT_HISTORY, Workbench
from benchmarks.workloads import DENSE

TITLE: Final = "CPU time per frame of five components, in µs, at real rates and at full speed"
GOAL: Final = 1.10
GOAL_BLAST: Final = {0: 1.10, 1: 1.50}
"""How many times the relay's cost, by the number of subscribers."""

BLAST: Final = "blast"
_RATES_HZ: Final = (200, 1000)
_CASES: Final = (("zenoh", 0), ("zenoh", 1), ("lcm", 0), ("lcm", 1))
_TEXTS: Final = {"zenoh": "Zenoh", "lcm": "LCM"}
_FIRST_FRAMES: Final = 2_000
_NOTE: Final = (
    "Ratios are medians of neighbouring runs, with the smallest and the largest. Native: the bare relay in "
    "Rust on Zenoh, in C on LCM. A blast is as fast as TCP and the program's own pace allow."
)


def _plan(quick: bool) -> tuple[int, float]:
    """Return the number of rounds, and how long a run lasts in s."""
    return (2, 0.4) if quick else (9, 1.5)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, lasting_s = _plan(quick)
    return len(_CASES) * (rounds * 4 * (2.5 * lasting_s + 0.3) + 8)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the CPU times per frame of each run, by case, rate and program."""
    rows = []
    for number, (output, count) in enumerate(_CASES):
        progress.step(f"{_TEXTS[output]}, {count} subscribers", number / len(_CASES))
        rows.append({"output": output, "subscribers": count, "cpu_us_per_frame": _case(output, count, quick)})
    return {"rows": rows}


def _case(output: str, count: int, quick: bool) -> dict[str, dict[str, list[float]]]:
    rounds, lasting_s = _plan(quick)
    clients = [GATEWAY, WITHOUT_HISTORY, RELAY, *([NATIVE] if NATIVE_RELAYS[output].exists() else [])]
    wanted = [((output == "zenoh") * count, (output == "lcm") * count)] * bool(count)
    costs_us: dict[str, dict[str, list[float]]] = {
        rate: {name: [] for name in clients} for rate in (BLAST, *map(str, _RATES_HZ))
    }
    is_zenoh = output == "zenoh"
    with Workbench(DENSE, zenoh=is_zenoh, lcm=not is_zenoh, subscribers=wanted, clients=clients) as workbench:
        blast_frames = {}
        for name in clients:
            workbench.blast(name, _FIRST_FRAMES)  # warms up
            sent, _ = workbench.blast(name, _FIRST_FRAMES)
            blast_frames[name] = math.ceil(lasting_s / 2 * sent.frames / sent.took_s)
        for _ in range(rounds):
            for name in clients:
                sent, cpu_s = workbench.blast(name, blast_frames[name])
                costs_us[BLAST][name].append(float(f"{1e6 * cpu_s / sent.frames:.4g}"))
            for rate_hz in _RATES_HZ:
                for name in clients:
                    sent, cpu_s = workbench.pace(name, round(lasting_s * rate_hz), rate_hz)
                    costs_us[str(rate_hz)][name].append(float(f"{1e6 * cpu_s / sent.frames:.4g}"))
    return costs_us


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the table of the result."""
    rows = []
    for row in result["rows"]:
        for rate, costs_us in row["cpu_us_per_frame"].items():
            medians = {name: f"{statistics.median(values):.1f}" for name, values in costs_us.items()}
            rows.append(
                [
                    f"{_TEXTS[row['output']]}, {row['subscribers']}, {_rate_text(rate)}",
                    *(medians.get(name, "") for name in (GATEWAY, WITHOUT_HISTORY, RELAY, NATIVE)),
                    table_cell(_compared(costs_us, RELAY)),
                    table_cell(_compared(costs_us, NATIVE)) if NATIVE in costs_us else "",
                ]
            )
    columns = ["output, subscribers, rate", "gateway", "without history", "relay", "native"]
    return [Table(TITLE, [*columns, "gateway ÷ relay", "gateway ÷ native"], rows, _NOTE)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return how often the gateway's cost is near enough to the relay's."""
    ratios = {
        (row["output"], row["subscribers"], rate): _compared(costs_us, RELAY).ratio
        for row in result["rows"]
        for rate, costs_us in row["cpu_us_per_frame"].items()
    }
    paced = [ratio for (_, _, rate), ratio in ratios.items() if rate != BLAST]
    goals = [_goal("at 200 and 1000 Hz", GOAL, paced)]
    for count, goal in GOAL_BLAST.items():
        blasts = [ratio for (_, number, rate), ratio in ratios.items() if (number, rate) == (count, BLAST)]
        subscribers = "one subscriber" if count else "no subscriber"
        goals.append(_goal(f"at full speed, {subscribers}", goal, blasts))
    return goals


def _goal(what: str, goal: float, ratios: list[float]) -> Goal:
    median, worst = statistics.median(ratios), max(ratios)
    measured = f"{median:.2f} times in the median of {len(ratios)} cases, {worst:.2f} in the worst"
    return Goal(f"CPU time {what}", f"at most {goal:.2f} times the relay's", measured, worst <= goal)


def _rate_text(rate: str) -> str:
    return rate if rate == BLAST else f"{rate} Hz"


def _compared(costs_us: dict[str, list[float]], other: str) -> Pair:
    return Pair.of({GATEWAY: costs_us[GATEWAY], other: costs_us[other]})
