"""Latency and CPU time at real rates, compared with the bare relay and a plain TCP client.

The latency is that from server to subscriber. The CPU time per frame includes waking up, and what the gateway
does every second.
"""

from itertools import chain
from typing import Any, Final

from benchmarks.processes import Worker
from benchmarks.report import Goal, Pair, Progress, Table, percentile, table_cell
from benchmarks.subscribers import subscribe_tcp
from benchmarks.workbench import GATEWAY, PLAIN_TCP, RELAY, Workbench
from benchmarks.workloads import DENSE, cuts
from gateway.messages.encode import CONTENT_OFFSET

TITLE: Final = "Latency from the server's send to the subscriber's callback"
CPU_TITLE: Final = "CPU time per frame of five components at these rates"
GOAL_P50: Final = 1.10
GOAL_P99: Final = 1.20
GOAL_CPU: Final = 1.15

_OUTPUTS: Final = {"Zenoh": (True, False), "LCM": (False, True)}
_RATES_HZ: Final = (100, 200, 1000)
_PERCENTILES: Final = (50.0, 99.0, 99.9)
_NAMES: Final = (GATEWAY, RELAY, PLAIN_TCP)


def _plan(quick: bool) -> tuple[int, dict[int, float]]:
    """Return the number of rounds, and the duration in s of one run at each rate."""
    return (3, {200: 1.0, 1000: 0.5}) if quick else (20, {100: 2.0, 200: 1.5, 1000: 1.0})


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, lasting_s = _plan(quick)
    return len(_OUTPUTS) * (4 + rounds * len(_NAMES) * sum(lasting_s.values()) * 1.05)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the percentiles of every run in µs, for each output and rate."""
    rounds, lasting_s = _plan(quick)
    rows = []
    for number, (output, (zenoh, lcm)) in enumerate(_OUTPUTS.items()):
        subscribers = [(int(zenoh), int(lcm))]
        clients = (GATEWAY, RELAY, PLAIN_TCP)
        with (
            Workbench(
                DENSE,
                zenoh=zenoh,
                lcm=lcm,
                subscribers=subscribers,
                reads=True,
                component="3d",
                clients=clients,
            ) as workbench,
            Worker(subscribe_tcp, workbench.ports[PLAIN_TCP], *_shape()) as plain,
        ):
            for rate_hz, each_s in lasting_s.items():
                progress.step(f"{output}, {rate_hz} Hz", (number + list(lasting_s).index(rate_hz) / 3) / 2)
                ages_us: dict[str, list[list[float]]] = {name: [] for name in _NAMES}
                costs_us = Pair(GATEWAY, RELAY)
                for name in _NAMES * rounds:
                    ages, cpu_us = _run(workbench, plain, name, rate_hz, each_s)
                    ages_us[name].append(ages)
                    if name != PLAIN_TCP:
                        costs_us.add(name, cpu_us)
                figures = _figures(ages_us) | {"cpu_us_per_frame": costs_us.as_dict()}
                rows.append({"output": output, "rate_hz": rate_hz, **figures})
    return {"rounds": rounds, "rows": rows}


def _shape() -> tuple[int, int]:
    packet = DENSE.packet()
    return len(packet), cuts(packet)[0].first + CONTENT_OFFSET


def _run(
    workbench: Workbench, plain: Worker, name: str, rate_hz: float, lasting_s: float
) -> tuple[list[float], float]:
    """Return the age of each message, and the program's CPU time per frame, in µs."""
    if name == PLAIN_TCP:
        plain.send("measure one connection")
    frames = round(rate_hz * lasting_s)
    _, cpu_s = workbench.pace(name, frames, rate_hz)
    if name == PLAIN_TCP:
        ages_us: list[float] = plain.reply()
        return ages_us, 0.0
    workbench.settle(frames, quiet_s=0.2)
    [received] = workbench.take_received()
    return [age_us for ages_us in received.ages_us.values() for age_us in ages_us], 1e6 * cpu_s / frames


def _figures(ages_us: dict[str, list[list[float]]]) -> dict[str, Any]:
    """Return the percentiles of each run, for the ratios, and of all runs together."""
    return {
        "messages": {name: sum(map(len, runs)) for name, runs in ages_us.items()},
        "runs_us": {
            f"p{each:g}": {
                name: [round(percentile(run, each), 1) for run in runs] for name, runs in ages_us.items()
            }
            for each in _PERCENTILES
        },
        "all_us": {
            f"p{each:g}": {
                name: round(percentile(list(chain(*runs)), each), 1) for name, runs in ages_us.items()
            }
            for each in _PERCENTILES
        },
    }


def _pair(row: dict[str, Any], percentile_name: str) -> Pair:
    runs = row["runs_us"][percentile_name]
    return Pair.of({name: runs[name] for name in (GATEWAY, RELAY)})


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = []
    for row in result["rows"]:
        for each in row["all_us"]:
            times_us = (f"{row['all_us'][each][name]:.0f}" for name in _NAMES)
            rows.append([row["output"], str(row["rate_hz"]), each, *times_us, table_cell(_pair(row, each))])
    columns = ["output", "Hz", "percentile", "gateway µs", "bare relay µs", "plain TCP client µs"]
    ratio = "gateway/relay, median of runs"
    costs = [
        [
            row["output"],
            str(row["rate_hz"]),
            *(f"{pair.median(name):.0f}" for name in (GATEWAY, RELAY)),
            table_cell(pair),
        ]
        for row, pair in _costs(result)
    ]
    cpu_columns = ["output", "Hz", "gateway CPU µs/frame", "relay CPU µs/frame", ratio]
    latency = Table(TITLE, [*columns, ratio], rows)
    return [latency, Table(CPU_TITLE, cpu_columns, costs)] if costs else [latency]


def _costs(result: dict[str, Any]) -> list[tuple[dict[str, Any], Pair]]:
    """Return the rows that have CPU times, which older results lack, and these."""
    return [(row, Pair.of(row["cpu_us_per_frame"])) for row in result["rows"] if "cpu_us_per_frame" in row]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the worst and the median ratio of the gateway to the relay."""
    results = []
    for name, goal in (("p50", GOAL_P50), ("p99", GOAL_P99)):
        ratios = sorted(_pair(row, name).ratio for row in result["rows"])
        results.append(
            Goal(
                f"{name} latency compared with the bare relay",
                f"at most {goal:.2f}",
                f"{ratios[-1]:.2f} in the worst case, {ratios[len(ratios) // 2]:.2f} in the median case",
                ratios[-1] <= goal,
            )
        )
    if costs := sorted(pair.ratio for _, pair in _costs(result)):
        results.append(
            Goal(
                "CPU time at real rates compared with the bare relay",
                f"at most {GOAL_CPU:.2f}",
                f"{costs[-1]:.2f} in the worst case, {costs[len(costs) // 2]:.2f} in the median case",
                costs[-1] <= GOAL_CPU,
            )
        )
    return results
