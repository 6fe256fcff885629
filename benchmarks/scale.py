"""The gateway's CPU time per frame with 1 to 64 subscribers to 3D messages of the lab workload."""

import statistics
from typing import Any, Final

from benchmarks import plots
from benchmarks.processes import ROOT
from benchmarks.report import Goal, Progress, Table
from benchmarks.workbench import GATEWAY, Workbench
from benchmarks.workloads import LAB

TITLE: Final = "Scaling: the gateway's CPU time per frame, by number of subscribers"
PLOT: Final = ROOT / "docs" / "dev" / "performance.png"
GOAL: Final = 1.5
_CONNECTIONS: Final = {
    "Zenoh, direct": (True, False),
    "Zenoh, through a router": (True, True),
    "LCM": (False, False),
}
_PER_PROCESS: Final = 16


def _counts(connection: str, quick: bool) -> list[int]:
    if quick:
        return [1, 4] if connection == "LCM" else [1, 8]
    return [1, 2, 4, 8, 16] if connection == "LCM" else [1, 2, 4, 8, 16, 32, 64]


def _plan(quick: bool) -> tuple[int, float]:
    """Return the number of rounds, and the duration of each run in s."""
    return (1, 1.0) if quick else (2, 4.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    rounds, lasting_s = _plan(quick)
    return rounds * sum((lasting_s + 3) * len(_counts(connection, quick)) for connection in _CONNECTIONS)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return the CPU times per frame, for each kind of connection and number of subscribers."""
    rounds, lasting_s = _plan(quick)
    runs = [
        (connection, count)
        for _ in range(rounds)
        for connection in _CONNECTIONS
        for count in _counts(connection, quick)
    ]
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    for number, (connection, count) in enumerate(runs):
        progress.step(f"{connection}, {count}", number / len(runs))
        new = {
            "connection": connection,
            "subscribers": count,
            "cpu_us_per_frame": [],
            "sent": 0,
            "lost": 0,
            "sent_hz": [],
        }
        row = rows.setdefault((connection, count), new)
        _run(row, *_CONNECTIONS[connection], round(lasting_s * LAB.rate_hz))
    ordered = sorted(
        rows.values(), key=lambda row: (list(_CONNECTIONS).index(row["connection"]), row["subscribers"])
    )
    result = {"rate_hz": LAB.rate_hz, "rows": ordered}
    if not quick:
        draw(result)
    return result


def _run(row: dict[str, Any], zenoh: bool, routed: bool, frames: int) -> None:
    count = row["subscribers"]
    in_processes = [min(_PER_PROCESS, count - first) for first in range(0, count, _PER_PROCESS)]
    subscribers = [(each, 0) if zenoh else (0, each) for each in in_processes]
    with Workbench(
        LAB,
        zenoh=zenoh,
        lcm=not zenoh,
        subscribers=subscribers,
        routed=routed,
        reads=True,
        component="3d",
        clients=(GATEWAY,),
    ) as workbench:
        sent, cpu_s = workbench.pace(GATEWAY, frames, LAB.rate_hz)
        workbench.settle(frames)
        lost = sum(received.missing(sent.first, frames, 1) for received in workbench.take_received())
    row["cpu_us_per_frame"].append(round(1e6 * cpu_s / frames, 1))
    row["sent"] += frames * count
    row["lost"] += lost
    row["sent_hz"].append(round(frames / sent.took_s, 1))


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = [
        [
            row["connection"],
            str(row["subscribers"]),
            f"{statistics.median(row['cpu_us_per_frame']):.0f}",
            "–".join(f"{edge:.0f}" for edge in (min(row["cpu_us_per_frame"]), max(row["cpu_us_per_frame"]))),
            f"{_times_one(result, row):.2f}",
            f"{row['lost']} of {row['sent']}",
        ]
        for row in result["rows"]
    ]
    columns = [
        "connection",
        "subscribers",
        "gateway CPU µs/frame",
        "range",
        "compared with 1 subscriber",
        "lost",
    ]
    note = (
        f"Frames of the lab workload at {result['rate_hz']:g} Hz with all five components; "
        "each subscriber receives 3D."
    )
    return [Table(TITLE, columns, rows, note)]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the CPU time with the most subscribers behind the router, compared with one."""
    row = [row for row in result["rows"] if row["connection"] == "Zenoh, through a router"][-1]
    times = _times_one(result, row)
    what = f"gateway CPU with {row['subscribers']} subscribers behind the router"
    return [Goal(what, f"at most {GOAL:g} times that with 1", f"{times:.2f} times", times <= GOAL)]


def _times_one(result: dict[str, Any], row: dict[str, Any]) -> float:
    """Return the ratio of a row's CPU time to that with one subscriber: the median over the rounds."""
    [one] = [
        each
        for each in result["rows"]
        if each["connection"] == row["connection"] and each["subscribers"] == 1
    ]
    pairs = zip(row["cpu_us_per_frame"], one["cpu_us_per_frame"], strict=True)
    return float(statistics.median(many_us / one_us for many_us, one_us in pairs))


def draw(result: dict[str, Any]) -> None:
    """Write the plot in the document."""
    figure, [axes] = plots.new_figure()
    for connection, colour in zip(_CONNECTIONS, plots.COLOURS, strict=False):
        rows = [row for row in result["rows"] if row["connection"] == connection]
        counts = [row["subscribers"] for row in rows]
        costs = [row["cpu_us_per_frame"] for row in rows]
        axes.plot(counts, [statistics.median(each) for each in costs], "o-", color=colour, label=connection)
        axes.fill_between(counts, list(map(min, costs)), list(map(max, costs)), color=colour, alpha=0.15)
    plots.label_subscribers(axes, [row["subscribers"] for row in result["rows"]])
    axes.set_ylabel("gateway's CPU time per frame (µs)")
    axes.set_title(f"CPU time by number of subscribers: lab workload, {result['rate_hz']:g} Hz", loc="left")
    axes.legend(frameon=False)
    plots.save(figure, PLOT)
