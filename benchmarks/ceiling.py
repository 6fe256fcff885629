"""Part 2: the gateway against a bare relay, blasted: frames per second and CPU time per frame."""

from itertools import chain
from typing import Any, Final

from benchmarks.comparing import Pair, table_cell
from benchmarks.report import Goal, Progress, Table
from benchmarks.stage import GATEWAY, RELAY, Stage
from benchmarks.workloads import DENSE

TITLE: Final = "Ceiling: gateway against a bare relay, as fast as TCP delivers"
GOAL: Final = 0.95

_SIDES: Final = {"Zenoh": (True, False), "LCM": (False, True), "both": (True, True)}
_ONE_URL: Final = "LCM, questions on its URL"
"""The gateway as it comes, which then is sent its own messages; the relay awaits no questions."""
_PER_PROCESS: Final = 4
_FIRST_FRAMES: Final = 2_000


def _cases(quick: bool) -> list[tuple[str, int, bool]]:
    counts = (0, 1, 4) if quick else (0, 1, 4, 16)
    cases = [
        (side, count, routed)
        for side, (zenoh, _) in _SIDES.items()
        for routed in ((False, True) if zenoh and not quick else (False,))
        for count in counts
    ]
    return [*cases, (_ONE_URL, 1, False)]


def expected_s(quick: bool) -> float:
    """Return about how long it takes."""
    return len(_cases(quick)) * (3 if quick else 15)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return, of every case, the figures of each pair of runs."""
    lasting_s, pairs = (0.1, 2) if quick else (0.5, 7)
    cases = _cases(quick)
    rows = []
    for number, (side, count, routed) in enumerate(cases):
        progress.step(f"{side}, {count} subscribers{', routed' if routed else ''}", number / len(cases))
        rows.append(_case(side, count, routed, lasting_s, pairs))
    return {"rows": rows}


def _case(side: str, count: int, routed: bool, lasting_s: float, pairs: int) -> dict[str, Any]:
    zenoh, lcm = _SIDES.get(side, (False, True))
    in_processes = [
        (min(_PER_PROCESS, count - first) * zenoh, min(_PER_PROCESS, count - first) * lcm)
        for first in range(0, count, _PER_PROCESS)
    ]
    rates = Pair(GATEWAY, RELAY)
    costs_us = Pair(GATEWAY, RELAY)
    with Stage(
        DENSE, zenoh=zenoh, lcm=lcm, subscribers=in_processes, routed=routed, questions_apart=side != _ONE_URL
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
            ]
        )
    columns = ["output", "way", "subscribers", "gateway frames/s", "relay frames/s", "ratio"]
    columns += ["gateway CPU µs/frame", "relay CPU µs/frame", "ratio"]
    return [Table(TITLE, columns, rows)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the worst ratio and the median one, and that of the gateway as it comes."""
    ratios: dict[str, list[float]] = {side: [] for side in (*_SIDES, _ONE_URL)}
    for row in result["rows"]:
        ratios[row["side"]].append(Pair.of(row["frames_per_s"]).ratio)
    [as_it_comes] = ratios.pop(_ONE_URL)
    found = sorted(chain(*ratios.values()))
    text = f"{found[0]:.2f} in the worst case, {found[len(found) // 2]:.2f} in the median one"
    return [
        Goal("blast throughput against the bare relay", f"at least {GOAL}", text, found[0] >= GOAL),
        Goal(
            "the same, LCM with questions on its URL",
            f"at least {GOAL}",
            f"{as_it_comes:.2f}",
            as_it_comes >= GOAL,
        ),
    ]
