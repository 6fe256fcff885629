"""Part 2: the gateway against a bare relay, blasted: frames per second and CPU time per frame."""

from typing import Any, Final

from benchmarks.comparing import Pair, table_cell
from benchmarks.report import Goal, Progress, Table
from benchmarks.stage import GATEWAY, RELAY, Stage
from benchmarks.workloads import DENSE

TITLE: Final = "Ceiling: gateway against a bare relay, as fast as TCP delivers"
GOAL: Final = 0.95

_SIDES: Final = {"Zenoh": (True, False), "LCM": (False, True), "both": (True, True)}
_PER_PROCESS: Final = 4
_FIRST_FRAMES: Final = 2_000
_BUSY: Final = 0.7
"""A relay that uses less of its processor waits for the subscribers, and its throughput is theirs."""


def _cases(quick: bool) -> list[tuple[str, int, bool]]:
    counts = (0, 4) if quick else (0, 1, 4, 16)
    return [
        (side, count, routed)
        for side, (zenoh, _) in _SIDES.items()
        for routed in ((False, True) if zenoh and not quick else (False,))
        for count in counts
    ]


def expected_s(quick: bool) -> float:
    """Return about how long it takes."""
    return len(_cases(quick)) * (3 if quick else 24)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return, of every case, the figures of each pair of runs."""
    lasting_s, pairs = (0.1, 2) if quick else (0.4, 15)
    cases = _cases(quick)
    rows = []
    for number, (side, count, routed) in enumerate(cases):
        progress.step(f"{side}, {count} subscribers{', routed' if routed else ''}", number / len(cases))
        rows.append(_case(side, count, routed, lasting_s, pairs))
    return {"rows": rows}


def _case(side: str, count: int, routed: bool, lasting_s: float, pairs: int) -> dict[str, Any]:
    zenoh, lcm = _SIDES[side]
    in_processes = [
        (min(_PER_PROCESS, count - first) * zenoh, min(_PER_PROCESS, count - first) * lcm)
        for first in range(0, count, _PER_PROCESS)
    ]
    rates = Pair(GATEWAY, RELAY)
    costs_us = Pair(GATEWAY, RELAY)
    with Stage(
        DENSE,
        zenoh=zenoh,
        lcm=lcm,
        subscribers=in_processes,
        routed=routed,
    ) as stage:
        stage.blast(GATEWAY, _FIRST_FRAMES)  # what is done for the first time is done now
        sent, _ = stage.blast(RELAY, _FIRST_FRAMES)
        frames = round(lasting_s * _FIRST_FRAMES / sent.took_s)
        for name in (GATEWAY, RELAY) * pairs:
            sent, cpu_s = stage.blast(name, frames)
            rates.add(name, sent.frames / sent.took_s)
            costs_us.add(name, 1e6 * cpu_s / sent.frames)
    return {
        "side": side,
        "subscribers": count,
        "routed": routed,
        "frames": frames,
        "frames_per_s": rates.as_dict(),
        "cpu_us_per_frame": costs_us.as_dict(),
    }


def tables(result: dict[str, Any]) -> list[Table]:
    """Return what is shown of the figures."""
    rows = []
    for row in result["rows"]:
        rates, costs = Pair.of(row["frames_per_s"]), Pair.of(row["cpu_us_per_frame"])
        rows.append(
            [
                row["side"],
                "routed" if row["routed"] else "direct",
                str(row["subscribers"]),
                f"{rates.median(GATEWAY):.0f}",
                f"{rates.median(RELAY):.0f}",
                table_cell(rates),
                f"{costs.median(GATEWAY):.1f}",
                f"{costs.median(RELAY):.1f}",
                table_cell(costs),
                f"{_relay_busy(row):.0%}",
            ]
        )
    columns = ["output", "way", "subscribers", "gateway frames/s", "relay frames/s", "ratio"]
    columns += ["gateway CPU µs/frame", "relay CPU µs/frame", "ratio", "relay busy"]
    note = f"A relay that is busy less than {_BUSY:.0%} waits for subscribers: not counted for the goal."
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the worst ratio and the median one, of the cases in which the subscribers are not the limit."""
    busy = [row for row in result["rows"] if _relay_busy(row) >= _BUSY] or result["rows"]
    ratios = sorted(Pair.of(row["frames_per_s"]).ratio for row in busy)
    found = (
        f"{ratios[0]:.2f} in the worst of {len(ratios)} cases, {ratios[len(ratios) // 2]:.2f} in the median"
    )
    return [Goal("blast throughput against the bare relay", f"at least {GOAL}", found, ratios[0] >= GOAL)]


def _relay_busy(row: dict[str, Any]) -> float:
    """Return which share of its processor the relay used."""
    cost_us, rate = Pair.of(row["cpu_us_per_frame"]), Pair.of(row["frames_per_s"])
    return cost_us.median(RELAY) * rate.median(RELAY) / 1e6
