"""The link is cut, routers are killed, and a gateway is: who misses what, and for how long."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from benchmarks import processes
from benchmarks.processes import Program
from benchmarks.report import Goal, Progress, Table
from benchmarks.sites.recorder import Recorder, figures_text
from benchmarks.sites.subscribers import Reports, is_component, received
from benchmarks.sites.two_sites import Ended, Site, TwoSites
from benchmarks.workloads import LAB

TITLE: Final = "Faults between two sites with a gateway, a subscriber and a recorder each"
GOAL_QUERY_S: Final = 5.0
_RATE_HZ: Final = 200
_COMPONENTS: Final = 5
_SETTLE_S: Final = 3.0
"""The wait after a fault, in which recorders get what they have missed."""

_PORT: Final = 3020


@dataclass(frozen=True)
class _Plan:
    cut_s: float
    kills: int
    away_s: float


def _plan(quick: bool) -> _Plan:
    return _Plan(cut_s=4.0, kills=1, away_s=1.0) if quick else _Plan(cut_s=30.0, kills=10, away_s=2.0)


def expected_s(quick: bool) -> float:
    """Return the approximate duration in s."""
    plan = _plan(quick)
    return plan.cut_s + (2 * plan.kills + 1) * (plan.away_s + 4) + len(_FAULTS) * (_SETTLE_S + 8) + 10


def measure(quick: bool, progress: Progress) -> dict[str, Any]:
    """Return a row for each fault."""
    plan = _plan(quick)
    progress.step("starting", 0)
    rows = []
    with _Laboratories() as laboratories:
        for number, (name, fault) in enumerate(_FAULTS.items()):
            progress.step(name, number / len(_FAULTS))
            rows.append({"fault": name, **laboratories.run(fault, plan, number)})
    return {"cut_s": plan.cut_s, "kills": plan.kills, "away_s": plan.away_s, "rows": rows}


class _Laboratories:
    """A context in which each site has a laboratory, and subscribers on both receive everything."""

    def __enter__(self) -> "_Laboratories":
        with contextlib.ExitStack() as stack:
            self.sites = stack.enter_context(TwoSites())
            self.gateways: dict[str, Program] = {}
            for name, site in self._named_sites():
                stack.enter_context(_simulator(site))
                self.gateways[name] = _gateway(name, site).__enter__()
                stack.callback(self._stop_gateway, name)
            self.subscribers = {
                name: stack.enter_context(site.subscribers(1)) for name, site in self._named_sites()
            }
            self.wait_until_received()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _named_sites(self) -> Iterator[tuple[str, Site]]:
        yield "a", self.sites.a
        yield "b", self.sites.b

    def _stop_gateway(self, name: str) -> None:
        self.gateways[name].__exit__()

    def restart_gateway(self, name: str) -> None:
        """Start the gateway of a site again."""
        self.gateways[name] = _gateway(name, getattr(self.sites, name)).__enter__()

    def wait_until_received(self) -> None:
        """Wait until both subscribers receive all components of both sources, from now on."""
        before = [_counts(each.look()) for each in self.subscribers.values()]

        def all_grew() -> bool:
            now = [_counts(each.look()) for each in self.subscribers.values()]
            return all(
                len(new) == 2 * _COMPONENTS and all(count > old.get(key, 0) for key, count in new.items())
                for old, new in zip(before, now, strict=True)
            )

        processes.wait_until(all_grew, "both subscribers receive all components of both sources")

    def run(
        self, fault: "Callable[[_Laboratories, _Plan], Ended]", plan: _Plan, number: int
    ) -> dict[str, Any]:
        """Return what a fault does: to the subscribers, to a query meanwhile, and to the recordings."""
        files = {name: site.folder / f"{number}.lcmlog" for name, site in self._named_sites()}
        with (
            Recorder(self.sites.a, files["a"]) as recorder_a,
            Recorder(self.sites.b, files["b"]) as recorder_b,
        ):
            for subscribers in self.subscribers.values():
                subscribers.take()
            query = fault(self, plan)
            self.wait_until_received()
            time.sleep(_SETTLE_S)
            seen = {name: subscribers.take() for name, subscribers in self.subscribers.items()}
            recordings = [recorder_a.stop(), recorder_b.stop()]
        return {
            "query": {
                "status": query.status,
                "took_s": round(query.took_s, 2),
                "says": " ".join(query.output.split()),
            },
            "subscribers": {
                f"{source} on {name.upper()}": _seen(reports, source)
                for name, reports in seen.items()
                for source in ("a", "b")
            },
            "recordings": [each.figures() for each in recordings],
            "different": recordings[0].differs_from(recordings[1]),
        }


def _seen(reports: list[Reports], source: str) -> dict[str, Any]:
    total = received(reports, source)
    return {"missed": total.missing, "silence_ms": round(total.longest_silence_ms)}


def _counts(sessions: list[Reports]) -> dict[str, int]:
    [session] = sessions
    return {key: report["messages"] for key, report in session.items() if is_component(key)}


def _simulator(site: Site) -> Program:
    sizes = {"markers": LAB.markers, "tools": LAB.tools, "analog": LAB.analog, "plates": LAB.plates}
    values = sizes | {"rate": _RATE_HZ, "analog-rate": _RATE_HZ, "port": _PORT, "log-level": "error"}
    options = [f"--{name}={value}" for name, value in values.items()]
    return Program(site.namespace.command(sys.executable, "-m", "gateway", "simulate", *options))


def _gateway(name: str, site: Site) -> Program:
    return site.gateway("gateway", [processes.source(name, _PORT)])


def _cut_link(laboratories: _Laboratories, plan: _Plan) -> Ended:
    laboratories.sites.network.cut()
    began_s = time.monotonic()
    query = laboratories.sites.b.run("params", "--source", "a")
    time.sleep(max(0.0, began_s + plan.cut_s - time.monotonic()))
    laboratories.sites.network.mend()
    return query


def _kill_router(name: str) -> Callable[[_Laboratories, _Plan], Ended]:
    def fault(laboratories: _Laboratories, plan: _Plan) -> Ended:
        site: Site = getattr(laboratories.sites, name)
        queries = []
        for _ in range(plan.kills):
            site.kill_router()
            began_s = time.monotonic()
            queries.append(site.run("params", "--source", name))
            time.sleep(max(0.0, began_s + plan.away_s - time.monotonic()))
            site.start_router()
            laboratories.wait_until_received()
        return max(queries, key=lambda each: each.took_s)

    return fault


def _kill_gateway(laboratories: _Laboratories, plan: _Plan) -> Ended:
    gateway = laboratories.gateways["b"]
    gateway.process.kill()
    gateway.process.wait()
    began_s = time.monotonic()
    query = laboratories.sites.a.run("params", "--source", "b")
    time.sleep(max(0.0, began_s + plan.away_s - time.monotonic()))
    laboratories.restart_gateway("b")
    return query


_FLOWS: Final = ("a on A", "a on B", "b on A", "b on B")
_UNDISTURBED: Final = {
    "link cut": ("a on A", "b on B"),
    "router A killed": ("b on B",),
    "router B killed": ("a on A",),
    "gateway B killed": ("a on A", "a on B"),
}
"""What does not depend on what is faulty."""

_FAULTS: Final = {
    "link cut": _cut_link,
    "router A killed": _kill_router("a"),
    "router B killed": _kill_router("b"),
    "gateway B killed": _kill_gateway,
}


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of the result."""
    rows = []
    queries = []
    for row in result["rows"]:
        rows.append(
            [
                row["fault"],
                *(f"{row['subscribers'][name]['silence_ms'] / 1000:.1f}" for name in _FLOWS),
                *(figures_text(recording) for recording in row["recordings"]),
                str(row["different"]),
            ]
        )
        query = row["query"]
        queries.append([row["fault"], f"{query['took_s']:.1f}", str(query["status"]), query["says"]])
    columns = [
        "fault",
        *(f"{name}, s" for name in _FLOWS),
        "recorder on A",
        "recorder on B",
        "messages that differ",
    ]
    note = (
        f"Each site has a source at {_RATE_HZ} Hz. “a on B” is the longest silence of the source of site A "
        f"at a subscriber on site B. The link is cut for {result['cut_s']:g} s. Each router is killed "
        f"{result['kills']} times and started again after at least {result['away_s']:g} s; so is the gateway "
        "of site B, once."
    )
    return [
        Table(TITLE, columns, rows, note),
        Table(
            "The slowest query for parameters during each fault",
            ["fault", "time, s", "exit status", "what it prints"],
            queries,
        ),
    ]


def goals(result: dict[str, Any]) -> list[Goal]:
    """Return whether recordings are complete, queries end in time, and the other site notices nothing."""
    rows = result["rows"]
    complete = sum(recording["complete"] for row in rows for recording in row["recordings"])
    different = sum(row["different"] for row in rows)
    slowest_s = max(row["query"]["took_s"] for row in rows)
    others = [row["subscribers"][flow] for row in rows for flow in _UNDISTURBED[row["fault"]]]
    missed, silence_ms = sum(each["missed"] for each in others), max(each["silence_ms"] for each in others)
    return [
        Goal(
            "faults: recordings on both sites",
            "complete and equal",
            f"{complete} of {2 * len(rows)} complete, {different} messages differ",
            complete == 2 * len(rows) and not different,
        ),
        Goal(
            "faults: queries fail with a sentence",
            f"within {GOAL_QUERY_S:g} s",
            f"within {slowest_s:.1f} s",
            slowest_s <= GOAL_QUERY_S and all(row["query"]["says"] for row in rows),
        ),
        Goal(
            "faults: what a site without the fault misses of its own source",
            "nothing",
            f"{missed} messages, silent for {silence_ms / 1000:.1f} s at most",
            not missed,
        ),
    ]
