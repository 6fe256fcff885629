"""Part 3: from the server's send to the subscriber's callback, beside the bare relay and a TCP client."""

from itertools import chain
from typing import Any, Final

from benchmarks.comparing import Pair, percentile, table_cell
from benchmarks.processes import Worker
from benchmarks.report import Goal, Progress, Table
from benchmarks.stage import GATEWAY, PLAIN, RELAY, Stage
from benchmarks.subscribers import subscribe_tcp
from benchmarks.workloads import DENSE, cuts
from gateway.messages.encode import CONTENT_OFFSET

TITLE: Final = "Latency: from the server's send to the subscriber's callback"
GOAL_P50: Final = 1.10
GOAL_P99: Final = 1.20

_SIDES: Final = {"Zenoh": (True, False), "LCM": (False, True)}
_RATES_HZ: Final = (100, 200, 1000)
_PERCENTILES: Final = (50.0, 99.0, 99.9)
_NAMES: Final = (GATEWAY, RELAY, PLAIN)


def _plan(quick: bool) -> tuple[int, dict[int, float]]:
    """Return how many rounds there are, and how long one run lasts at each rate, s."""
    return (2, {200: 0.5, 1000: 0.5}) if quick else (20, {100: 2.0, 200: 1.5, 1000: 1.0})


def expected_s(quick: bool) -> float:
    """Return about how long it takes."""
    rounds, lasting_s = _plan(quick)
    return len(_SIDES) * (4 + rounds * len(_NAMES) * sum(lasting_s.values()) * 1.05)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return, of each side and rate, the percentiles of every run, µs."""
    rounds, lasting_s = _plan(quick)
    rows = []
    for number, (side, (zenoh, lcm)) in enumerate(_SIDES.items()):
        subscribers = [(int(zenoh), int(lcm))]
        clients = (GATEWAY, RELAY, PLAIN)
        with (
            Stage(
                DENSE,
                zenoh=zenoh,
                lcm=lcm,
                subscribers=subscribers,
                reads=True,
                component="3d",
                clients=clients,
            ) as stage,
            Worker(subscribe_tcp, stage.ports[PLAIN], *_shape()) as plain,
        ):
            for rate_hz, each_s in lasting_s.items():
                progress.step(f"{side}, {rate_hz} Hz", (number + list(lasting_s).index(rate_hz) / 3) / 2)
                ages_us: dict[str, list[list[float]]] = {name: [] for name in _NAMES}
                for name in _NAMES * rounds:
                    ages_us[name].append(_run(stage, plain, name, rate_hz, each_s))
                rows.append({"side": side, "rate_hz": rate_hz, **_figures(ages_us)})
    return {"rounds": rounds, "rows": rows}


def _shape() -> tuple[int, int]:
    packet = DENSE.packet()
    return len(packet), cuts(packet)[0].first + CONTENT_OFFSET


def _run(stage: Stage, plain: Worker, name: str, rate_hz: float, lasting_s: float) -> list[float]:
    if name == PLAIN:
        plain.send("one connection")
    frames = round(rate_hz * lasting_s)
    stage.pace(name, frames, rate_hz)
    if name == PLAIN:
        ages_us: list[float] = plain.reply()
        return ages_us
    stage.settle(frames, quiet_s=0.2)
    [heard] = stage.take()
    return [age_us for ages_us in heard.ages_us.values() for age_us in ages_us]


def _figures(ages_us: dict[str, list[list[float]]]) -> dict[str, Any]:
    """Return percentiles of each run, which make pairs, and of all runs together."""
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
    """Return what is shown of the figures."""
    rows = []
    for row in result["rows"]:
        for each in row["all_us"]:
            times_us = (f"{row['all_us'][each][name]:.0f}" for name in _NAMES)
            rows.append([row["side"], str(row["rate_hz"]), each, *times_us, table_cell(_pair(row, each))])
    columns = ["output", "Hz", "percentile", "gateway µs", "bare relay µs", "plain TCP client µs"]
    return [Table(TITLE, [*columns, "gateway to relay, median of runs"], rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the worst ratios of gateway to relay."""
    found = []
    for name, goal in (("p50", GOAL_P50), ("p99", GOAL_P99)):
        ratios = sorted(_pair(row, name).ratio for row in result["rows"])
        found.append(
            Goal(
                f"{name} latency against the bare relay",
                f"at most {goal:.2f}",
                f"{ratios[-1]:.2f} in the worst case, {ratios[len(ratios) // 2]:.2f} in the median one",
                ratios[-1] <= goal,
            )
        )
    return found
