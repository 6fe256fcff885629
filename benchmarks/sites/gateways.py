"""Many gateways at one router: finding them, their tables, and what each of them costs."""

import contextlib
import re
import signal
import subprocess
import sys
import time
from typing import Any, Final

from benchmarks import processes
from benchmarks.processes import ROOT, Program, cpu_s, memory_bytes
from benchmarks.report import Goal, Progress, Table
from benchmarks.sites.two_sites import Ended, Site, TwoSites

GOAL_S: Final = 2.0
SOURCES_EACH: Final = 5
_RATE_HZ: Final = 5
_PORTS: Final = (3020, 3021, 3022, 3023, 3024)
"""One simulator for each source of a gateway; all gateways receive from the same ones."""

_REPEATS: Final = 3
_TOP_S: Final = 30.0  # catches what hangs


def _plan(quick: bool) -> tuple[int, float]:
    """Return the number of gateways, and for how long their CPU time is measured, in s."""
    return (3, 3.0) if quick else (20, 20.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    gateways, lasting_s = _plan(quick)
    return 15 + 2 * gateways + lasting_s + _REPEATS * 6


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return how long the commands take, and what each gateway uses."""
    count, lasting_s = _plan(quick)
    progress.step(f"starting {count} gateways", 0)
    with contextlib.ExitStack() as stack:
        site = stack.enter_context(TwoSites()).a
        for port in _PORTS:
            stack.enter_context(_simulator(site, port))
        gateways = [stack.enter_context(_gateway(site, number)) for number in range(count)]
        wanted = count * SOURCES_EACH
        processes.wait_until(lambda: _sources_streaming(site) == wanted, f"{wanted} sources have data")
        progress.step("CPU time and memory", 0.6)
        before_s = [cpu_s(each.pid) for each in gateways]
        began_s = time.monotonic()
        time.sleep(lasting_s)
        took_s = time.monotonic() - began_s
        shares = [
            (cpu_s(each.pid) - before) / took_s for each, before in zip(gateways, before_s, strict=True)
        ]
        memory = [memory_bytes(each.pid) for each in gateways]
        progress.step("list and top", 0.8)
        commands = {
            "list": [site.run("list", "--json") for _ in range(_REPEATS)],
            "top, until it shows all": [_top(site, wanted) for _ in range(_REPEATS)],
            "params of one source": [site.run("params", "--source", "g0-s0") for _ in range(_REPEATS)],
        }
    return {
        "gateways": count,
        "sources": wanted,
        "cpu_share": [round(each, 4) for each in shares],
        "memory_bytes": memory,
        "commands": {
            name: {
                "took_s": [round(run.took_s, 2) for run in runs],
                "statuses": [run.status for run in runs],
                "sources": [_named(run) for run in runs],
            }
            for name, runs in commands.items()
        },
    }


def _simulator(site: Site, port: int) -> Program:
    values = {"port": port, "rate": _RATE_HZ, "analog-rate": _RATE_HZ, "log-level": "error"}
    options = [f"--{name}={value}" for name, value in values.items()]
    return Program(site.namespace.command(sys.executable, "-m", "gateway", "simulate", *options))


def _gateway(site: Site, number: int) -> Program:
    sources = [processes.source(f"g{number}-s{each}", port) for each, port in enumerate(_PORTS)]
    return site.gateway(f"gateway-{number}", sources)


def _sources_streaming(site: Site) -> int:
    listed = site.run("list", "--json")
    return listed.output.count('"streaming"') if listed.status == 0 else 0


def _top(site: Site, wanted: int) -> Ended:
    """Run ``top`` until it has data of all sources; it prints a line each second."""
    began_s = time.monotonic()
    with subprocess.Popen(  # noqa: S603 - the command is our own
        site.command("top", "--json"), cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None  # noqa: S101 - for mypy
        while True:
            line = process.stdout.readline()
            shown = Ended(0, time.monotonic() - began_s, line)
            if _named(shown) == wanted or not shown.output or shown.took_s > _TOP_S:
                break
        process.send_signal(signal.SIGINT)
    return shown


def _named(run: Ended) -> int:
    """Return how many different sources the output names."""
    return len(set(re.findall(r"\bg\d+-s\d+\b", run.output)))


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    title = f"{result['gateways']} gateways with {SOURCES_EACH} sources each at one router"
    commands = [
        [name, " ".join(f"{each:.1f}" for each in runs["took_s"]), " ".join(map(str, runs["sources"]))]
        for name, runs in result["commands"].items()
    ]
    mib = [each / 2**20 for each in result["memory_bytes"]]
    shares = result["cpu_share"]
    costs = [
        ["memory, MiB", f"{min(mib):.0f}", f"{sum(mib) / len(mib):.0f}", f"{max(mib):.0f}"],
        ["CPU of one core", f"{min(shares):.1%}", f"{sum(shares) / len(shares):.1%}", f"{max(shares):.1%}"],
    ]
    note = f"Every source has five components at {_RATE_HZ} Hz, and nobody subscribes."
    return [
        Table(title, ["command", "time of each run, s", "sources that it shows"], commands),
        Table("What one of these gateways uses", ["what", "smallest", "mean", "largest"], costs, note),
    ]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return whether the commands find everything in time."""
    found = []
    for name in ("list", "top, until it shows all"):
        runs = result["commands"][name]
        longest_s, fewest = max(runs["took_s"]), min(runs["sources"])
        found.append(
            Goal(
                f"{name}: {result['sources']} sources of {result['gateways']} gateways",
                f"all, in {GOAL_S:g} s",
                f"{fewest} in {longest_s:.1f} s",
                longest_s <= GOAL_S and fewest == result["sources"],
            )
        )
    return found
