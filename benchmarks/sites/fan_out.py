"""Up to 256 subscribers on two sites: the gateway's CPU time, the link's bytes, and what is lost."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks import plots, processes
from benchmarks.processes import ROOT, Worker, cpu_s
from benchmarks.report import Goal, Progress, Table
from benchmarks.sites.subscribers import Subscribers, is_component, percentile_ms, received
from benchmarks.sites.two_sites import TwoSites
from benchmarks.workbench import GATEWAY
from benchmarks.workloads import DENSE, LAB, Paced, Sent, Workload, send

TITLE: Final = "Subscribers on two sites"
RATE_HZ: Final = 200
WORKLOADS: Final = {"lab": LAB, "dense": DENSE}
PLOT: Final = ROOT / "docs" / "dev" / "scale.svg"
GOAL_CPU: Final = 1.5
_COMPONENTS: Final = 5
_FIRST_FRAMES: Final = 20
_TWO_COPIES: Final = 1.9
"""With headers, one copy is 1.1 to 1.3 times the size of the messages."""


def _plan(quick: bool) -> tuple[Sequence[tuple[int, int]], float]:
    """Return the numbers of subscribers on site A and on site B, and the duration of each run in s."""
    if quick:
        return ((1, 0), (1, 1), (16, 16)), 3.0
    return ((1, 0), (1, 1), (8, 8), (32, 32), (64, 64), (96, 96), (128, 128)), 10.0


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    counts, lasting_s = _plan(quick)
    return len(WORKLOADS) * len(counts) * (lasting_s + 8)


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return a row for each workload and number of subscribers."""
    counts, lasting_s = _plan(quick)
    runs = [(name, *each) for name in WORKLOADS for each in counts]
    rows = []
    for number, (name, on_a, on_b) in enumerate(runs):
        progress.step(f"{name}, {on_a} + {on_b} subscribers", number / len(runs))
        row = _run(WORKLOADS[name], on_a, on_b, round(lasting_s * RATE_HZ))
        rows.append({"workload": name, "on_a": on_a, "on_b": on_b, **row})
    result = {"seconds": lasting_s, "rows": rows}
    if not quick:
        draw(result)
    return result


def _run(workload: Workload, on_a: int, on_b: int, frames: int) -> dict[str, Any]:
    with (
        Worker(send, workload, [GATEWAY]) as sender,
        TwoSites() as sites,
        sites.a.gateway("gateway", [processes.source(GATEWAY, sender.started[GATEWAY])]) as gateway,
        sites.a.subscribers(on_a) as subscribers_a,
        sites.b.subscribers(on_b) as subscribers_b,
    ):
        both = (subscribers_a, subscribers_b)
        connect(sender, both)

        def used_s() -> dict[str, float]:
            return {
                "gateway": cpu_s(gateway.pid),
                "router A": cpu_s(sites.a.router.pid),
                "router B": cpu_s(sites.b.router.pid),
                "subscribers": sum(each.cpu_s() for each in both),
                "idle": _idle_s(),
            }

        before_s, bytes_before = used_s(), sites.network.bytes_to_b()
        sent: Sent = sender.ask(Paced(GATEWAY, frames, RATE_HZ))
        spent_s = {name: value - before_s[name] for name, value in used_s().items()}
        expected = {"a": frames * _COMPONENTS * on_a, "b": frames * _COMPONENTS * on_b}
        at = {name: each.wait_for(expected[name]) for name, each in zip("ab", both, strict=True)}
        link_bytes = sites.network.bytes_to_b() - bytes_before
    total = {name: received(sessions) for name, sessions in at.items()}
    return {
        "sent_hz": round(frames / sent.took_s, 1),
        "cpu_us_per_frame": round(1e6 * spent_s["gateway"] / frames, 1),
        "cores": {name: round(each_s / sent.took_s, 3) for name, each_s in spent_s.items()},
        "expected": expected,
        "lost": {name: expected[name] - each.messages for name, each in total.items()},
        "link_bytes": link_bytes,
        "message_bytes": received(at["b"][:1]).message_bytes,
        "age_ms": {
            name: {f"p{each:g}": round(percentile_ms(total[name].ages_us, each), 2) for each in (50, 99)}
            for name in total
        },
    }


def connect(sender: Worker, both: Sequence[Subscribers]) -> None:
    """Send frames until all sessions have received all components, and let them start to count from zero."""

    def connected() -> bool:
        sender.ask(Paced(GATEWAY, _FIRST_FRAMES, RATE_HZ))
        sessions = [session for each in both for session in each.look()]
        return all(sum(is_component(key) for key in session) == _COMPONENTS for session in sessions)

    processes.wait_until(connected, "all subscribers receive all components")
    for each in both:
        each.wait_for(sys.maxsize)


def _idle_s() -> float:
    """Return the time that all cores have been idle, in s."""
    ticks = Path("/proc/stat").read_text().split(maxsplit=5)[4]
    return int(ticks) / os.sysconf("SC_CLK_TCK")


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = [
        [
            f"{row['workload']}, {row['on_a']} + {row['on_b']}",
            f"{row['cpu_us_per_frame']:.0f}",
            f"{_times_one(result, row):.2f}",
            f"{row['lost']['a']} of {row['expected']['a']}",
            f"{row['lost']['b']} of {row['expected']['b']}",
            f"{row['link_bytes'] / row['message_bytes']:.2f}" if row["on_b"] else "–",
            *(f"{row['age_ms'][site]['p50']:.1f} / {row['age_ms'][site]['p99']:.1f}" for site in "ab"),
        ]
        for row in result["rows"]
    ]
    columns = [
        "workload, subscribers on A + B",
        "gateway CPU µs/frame",
        "compared with 1",
        "lost on A",
        "lost on B",
        "link bytes per message byte",
        "age on A, ms, p50 / p99",
        "age on B",
    ]
    note = (
        f"{RATE_HZ} frames per second for {result['seconds']:g} s, five messages each, to every subscriber."
    )
    cores = [
        [
            f"{row['workload']}, {row['on_a']} + {row['on_b']}",
            f"{row['sent_hz']:g}",
            *(f"{row['cores'][name]:.2f}" for name in row["cores"]),
        ]
        for row in result["rows"]
    ]
    names = list(result["rows"][0]["cores"])
    return [
        Table(TITLE, columns, rows, note),
        Table(
            "What limits them: cores used during each run",
            ["workload, subscribers on A + B", "frames/s sent", *names],
            cores,
        ),
    ]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return the goals of each workload: CPU time, bytes on the link, and loss."""
    found = []
    for workload in WORKLOADS:
        rows = [row for row in result["rows"] if row["workload"] == workload]
        most = rows[-1]
        subscribers = most["on_a"] + most["on_b"]
        times = _times_one(result, most)
        what = f"{workload}: gateway CPU with {subscribers} subscribers on two sites"
        found.append(
            Goal(what, f"at most {GOAL_CPU:g} times that with 1", f"{times:.2f} times", times <= GOAL_CPU)
        )
        copies = most["link_bytes"] / most["message_bytes"]
        what = f"{workload}: bytes on the link"
        found.append(Goal(what, "one copy of each message", f"{copies:.2f} times", copies < _TWO_COPIES))
        lost, expected = (sum(most[name].values()) for name in ("lost", "expected"))
        lossless = max(
            (row["on_a"] + row["on_b"] for row in rows if not any(row["lost"].values())), default=0
        )
        measured = f"{lost} of {expected}" + (f"; none with {lossless} subscribers" if lost else "")
        found.append(Goal(f"{workload}: loss with {subscribers} subscribers", "none", measured, not lost))
    return found


def _times_one(result: dict[str, Any], row: dict[str, Any]) -> float:
    """Return the gateway's CPU time per frame, compared with that for one subscriber."""
    [one] = [
        each
        for each in result["rows"]
        if each["workload"] == row["workload"] and (each["on_a"], each["on_b"]) == (1, 0)
    ]
    return float(row["cpu_us_per_frame"] / one["cpu_us_per_frame"])


def draw(result: dict[str, Any]) -> None:
    """Write the plot in the document: the cores that each kind of process uses."""
    figure, panels = plots.new_figure(len(WORKLOADS))
    for axes, workload in zip(panels, WORKLOADS, strict=True):
        rows = [row for row in result["rows"] if row["workload"] == workload]
        counts = [row["on_a"] + row["on_b"] for row in rows]
        for name, colour in zip(
            ("gateway", "router A", "router B", "subscribers"), plots.COLOURS, strict=True
        ):
            axes.plot(counts, [row["cores"][name] for row in rows], "o-", color=colour, label=name)
        plots.label_subscribers(axes, counts)
        axes.set_title(f"{workload}, {RATE_HZ} Hz", loc="left")
    panels[0].set_ylabel("cores used")
    panels[0].legend(frameon=False)
    plots.save(figure, PLOT)
