"""Suites of benchmarks: the parts of each, and the command that measures them and updates their documents."""

import argparse
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from rich.console import Console

from benchmarks import report
from benchmarks.processes import ROOT
from benchmarks.report import Table


@dataclass(frozen=True)
class Suite:
    """Benchmarks that one command runs."""

    package: str
    parts: tuple[str, ...]
    """The parts in order; each is a module of the package."""
    documents: tuple[Path, ...]
    """Each shows the sections for which it has markers."""

    @property
    def results(self) -> Path:
        """The file of the results that the documents show."""
        return ROOT / self.package.replace(".", "/") / "results.json"

    @property
    def quick_results(self) -> Path:
        """The file of the results of quick runs, which git ignores."""
        return self.results.with_name("results-quick.json")

    def part(self, name: str) -> ModuleType:
        """Return the module of a part, with ``expected_s``, ``measure``, ``tables`` and ``goals``."""
        return importlib.import_module(f"{self.package}.{name}")

    def sections(self, results: dict[str, Any]) -> dict[str, list[Table]]:
        """Return the tables of each part that has results, and of the sections "machine" and "goals"."""
        measured: dict[str, Any] = {name: results[name] for name in self.parts if name in results}
        goals = [goal for name, result in measured.items() for goal in self.part(name).goals(result)]
        return {
            "machine": [report.machines_table(measured)],
            "goals": [report.goals_table(goals)],
            **{name: self.part(name).tables(result) for name, result in measured.items()},
        }


GATEWAY: Final = Suite(
    "benchmarks",
    (
        "own_cost",
        "rates",
        "live",
        "outputs",
        "ceiling",
        "latency",
        "loss",
        "resources",
        "scale",
        "queries",
        "replay",
        "history",
    ),
    (ROOT / "docs" / "dev" / "performance.md",),
)
"""What the gateway costs in addition to Zenoh and LCM."""

SITES: Final = Suite(
    "benchmarks.sites",
    ("fan_out", "slow_link", "faults", "gateways", "display"),
    (ROOT / "docs" / "dev" / "scale.md", ROOT / "docs" / "dev" / "reliability.md"),
)
"""Two sites, each with a router, and the link between them."""


def run(suite: Suite, prepare: Callable[[], None] = lambda: None) -> int:
    """Measure, store the results, print the tables, and update them in the document; return the exit status.

    ``prepare`` is called before the first measurement.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {suite.package}")
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"what to measure: {', '.join(suite.parts)} (default: all)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="measure briefly and leave the document unchanged"
    )
    parser.add_argument(
        "--render", action="store_true", help="do not measure, only update the tables in the document"
    )
    options = parser.parse_args()
    if unknown := set(options.parts) - set(suite.parts):
        parser.error(f"unknown part: {', '.join(sorted(unknown))}")
    file = suite.quick_results if options.quick else suite.results
    selected = [name for name in suite.parts if name in (options.parts or suite.parts) and not options.render]
    prepare()
    progress = report.Progress({name: suite.part(name).expected_s(options.quick) for name in selected})
    for name in selected:
        progress.begin(name)
        report.merge(file, name, suite.part(name).measure(options.quick, progress))
    sections = suite.sections(report.load(file))
    for name in ("machine", *(selected or suite.parts), "goals"):
        for table in sections.get(name, []):
            table.show(Console())
    if not options.quick:
        for document in suite.documents:
            document.write_text(report.rendered(document.read_text(), sections))
    return 0
