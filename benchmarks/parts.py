"""The parts of the benchmarks, in order, and the tables of their results."""

import importlib
from types import ModuleType
from typing import Any, Final

from benchmarks.report import Table, goals_table, machines_table

NAMES: Final = (
    "own_cost",
    "outputs",
    "ceiling",
    "latency",
    "loss",
    "resources",
    "scale",
    "queries",
    "replay",
)


def part(name: str) -> ModuleType:
    """Return the module of a part, with ``expected_s``, ``measure``, ``tables`` and ``goals``."""
    return importlib.import_module(f"benchmarks.{name}")


def sections(results: dict[str, Any]) -> dict[str, list[Table]]:
    """Return the tables of each part that has results, and of the sections "machine" and "goals"."""
    measured: dict[str, Any] = {name: results[name] for name in NAMES if name in results}
    goals = [goal for name, result in measured.items() for goal in part(name).goals(result)]
    return {
        "machine": [machines_table(measured)],
        "goals": [goals_table(goals)],
        **{name: part(name).tables(result) for name, result in measured.items()},
    }
