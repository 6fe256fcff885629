"""Part 6: the gateway's CPU per frame with ever more subscribers of the lab's 3D messages, as a curve."""

import statistics
from typing import Any, Final

from benchmarks.processes import ROOT
from benchmarks.report import Goal, Progress, Table
from benchmarks.stage import GATEWAY, Stage
from benchmarks.workloads import LAB

TITLE: Final = "Scale: the gateway's CPU per frame, and its subscribers"
PICTURE: Final = ROOT / "docs" / "performance.png"
GOAL: Final = 1.5
_WAYS: Final = {
    "Zenoh, direct": (True, False),
    "Zenoh, through a router": (True, True),
    "LCM": (False, False),
}
_PER_PROCESS: Final = 16
_COLOURS: Final = ("#1f6fb4", "#d1702a", "#3c8d40")


def _counts(way: str, quick: bool) -> list[int]:
    if quick:
        return [1, 4] if way == "LCM" else [1, 8]
    return [1, 2, 4, 8, 16] if way == "LCM" else [1, 2, 4, 8, 16, 32, 64]


def _plan(quick: bool) -> tuple[int, float]:
    """Return the rounds, and how long each run lasts, s."""
    return (1, 1.0) if quick else (2, 4.0)


def expected_s(quick: bool) -> float:
    """Return about how long it takes."""
    rounds, lasting_s = _plan(quick)
    return rounds * sum((lasting_s + 3) * len(_counts(way, quick)) for way in _WAYS)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return, of each way and number of subscribers, the CPU time per frame of every round."""
    rounds, lasting_s = _plan(quick)
    runs = [(way, count) for _ in range(rounds) for way in _WAYS for count in _counts(way, quick)]
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    for number, (way, count) in enumerate(runs):
        progress.step(f"{way}, {count}", number / len(runs))
        new = {"way": way, "subscribers": count, "cpu_us_per_frame": [], "sent": 0, "lost": 0, "sent_hz": []}
        row = rows.setdefault((way, count), new)
        _run(row, *_WAYS[way], round(lasting_s * LAB.rate_hz))
    ordered = sorted(rows.values(), key=lambda row: (list(_WAYS).index(row["way"]), row["subscribers"]))
    result = {"rate_hz": LAB.rate_hz, "rows": ordered}
    if not quick:
        draw(result)
    return result


def _run(row: dict[str, Any], zenoh: bool, routed: bool, frames: int) -> None:
    count = row["subscribers"]
    in_processes = [min(_PER_PROCESS, count - first) for first in range(0, count, _PER_PROCESS)]
    subscribers = [(each, 0) if zenoh else (0, each) for each in in_processes]
    with Stage(
        LAB,
        zenoh=zenoh,
        lcm=not zenoh,
        subscribers=subscribers,
        routed=routed,
        reads=True,
        component="3d",
        clients=(GATEWAY,),
    ) as stage:
        sent, cpu_s = stage.pace(GATEWAY, frames, LAB.rate_hz)
        stage.settle(frames)
        lost = sum(heard.missing(sent.first, frames, 1) for heard in stage.take())
    row["cpu_us_per_frame"].append(round(1e6 * cpu_s / frames, 1))
    row["sent"] += frames * count
    row["lost"] += lost
    row["sent_hz"].append(round(frames / sent.took_s, 1))


def tables(result: dict[str, Any]) -> list[Table]:
    """Return what is shown of the figures."""
    rows = [
        [
            row["way"],
            str(row["subscribers"]),
            f"{statistics.median(row['cpu_us_per_frame']):.0f}",
            "–".join(f"{edge:.0f}" for edge in (min(row["cpu_us_per_frame"]), max(row["cpu_us_per_frame"]))),
            f"{_times_one(result, row):.2f}",
            f"{row['lost']} of {row['sent']}",
        ]
        for row in result["rows"]
    ]
    columns = ["way", "subscribers", "gateway CPU µs/frame", "rounds", "times that with 1", "lost"]
    note = (
        f"Frames of the lab workload, all five components, at {result['rate_hz']:g} Hz; subscribers take 3D."
    )
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return what the most subscribers behind the router cost, against one."""
    row = [row for row in result["rows"] if row["way"] == "Zenoh, through a router"][-1]
    times = _times_one(result, row)
    what = f"gateway CPU with {row['subscribers']} subscribers behind the router"
    return [Goal(what, f"at most {GOAL:g} times that with 1", f"{times:.2f} times", times <= GOAL)]


def _times_one(result: dict[str, Any], row: dict[str, Any]) -> float:
    """Return by how much a row costs more than one subscriber: the median of the rounds' ratios."""
    [one] = [each for each in result["rows"] if each["way"] == row["way"] and each["subscribers"] == 1]
    pairs = zip(row["cpu_us_per_frame"], one["cpu_us_per_frame"], strict=True)
    return float(statistics.median(many_us / one_us for many_us, one_us in pairs))


def draw(result: dict[str, Any]) -> None:
    """Write the picture of the document."""
    import matplotlib as mpl  # noqa: PLC0415 - the tests of the benchmarks do without
    from matplotlib.figure import Figure  # noqa: PLC0415 - as above

    mpl.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.subplots()
    for way, colour in zip(_WAYS, _COLOURS, strict=True):
        rows = [row for row in result["rows"] if row["way"] == way]
        counts = [row["subscribers"] for row in rows]
        costs = [row["cpu_us_per_frame"] for row in rows]
        axes.plot(counts, [statistics.median(each) for each in costs], "o-", color=colour, label=way)
        axes.fill_between(counts, list(map(min, costs)), list(map(max, costs)), color=colour, alpha=0.15)
    axes.set_xscale("log", base=2)
    ticks = sorted({row["subscribers"] for row in result["rows"]})
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_ylim(bottom=0)
    axes.set(xlabel="subscribers", ylabel="gateway's CPU time per frame (µs)")
    axes.set_title(f"What subscribers cost the gateway: lab workload, {result['rate_hz']:g} Hz", loc="left")
    axes.grid(axis="y", color="0.9")
    axes.legend(frameon=False)
    figure.savefig(PICTURE, dpi=130)
