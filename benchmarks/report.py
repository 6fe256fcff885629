"""The results of benchmarks: goals, tables, progress, and the file with all figures."""

import json
import math
import os
import platform
import re
import statistics
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Self

from rich.console import Console
from rich.table import Table as RichTable

from benchmarks.processes import ROOT, router_kind
from gateway import version_text


@dataclass(frozen=True)
class Table:
    """A table of text, with ``note`` below it."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def markdown(self) -> str:
        """Return the table in Markdown, with only the first column left-aligned."""
        lines = [
            f"**{self.title}**",
            "",
            f"| {' | '.join(self.columns)} |",
            "|---|" + "---:|" * (len(self.columns) - 1),
            *(f"| {' | '.join(row)} |" for row in self.rows),
        ]
        return "\n".join([*lines, "", self.note] if self.note else lines)

    def show(self, console: Console) -> None:
        """Print the table on ``console``."""
        table = RichTable(title=self.title, title_justify="left", caption=self.note or None)
        for number, name in enumerate(self.columns):
            table.add_column(name, justify="right" if number else "left")
        for row in self.rows:
            table.add_row(*row)
        console.print(table)


class Goal(NamedTuple):
    """A target value, and whether the measured value reaches it."""

    what: str
    goal: str
    measured: str
    reached: bool


def goals_table(goals: Iterable[Goal]) -> Table:
    """Return the table of all goals."""
    rows = [(*goal[:3], "yes" if goal.reached else "**no**") for goal in goals]
    return Table("Goals", ["what", "goal", "measured", "reached"], rows)


class Progress:
    """Prints progress, one line per step: the part, the time so far, and the expected remaining time.

    ``expected_s`` maps each selected part to its expected duration.
    """

    def __init__(self, expected_s: dict[str, float]) -> None:
        self._expected_s = expected_s
        self._began_s = time.monotonic()
        self._part = ""

    def begin(self, part: str) -> None:
        """Start a part."""
        self._part = part

    def step(self, text: str, done: float) -> None:
        """Print the next step of the part; ``done`` (0 to 1) is the finished share of the part."""
        names = list(self._expected_s)
        at = names.index(self._part)
        left_s = sum(list(self._expected_s.values())[at:]) - done * self._expected_s[self._part]
        passed_s = time.monotonic() - self._began_s
        print(
            f"[{passed_s // 60:2.0f}:{passed_s % 60:02.0f}] part {at + 1} of {len(names)}, {self._part} "
            f"{done:4.0%}: {text}; about {max(1, round(left_s / 60))} min left",
            flush=True,
        )


@cache
def machine() -> dict[str, str]:
    """Return the hardware and the software versions of this run.

    Cached, because the results change files, and with them the output of git describe.
    """
    model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"],  # noqa: S607 - git is found through PATH
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "processor": model[1] if model else platform.machine(),
        "cores": str(os.cpu_count()),
        "kernel": platform.release(),
        "Python": platform.python_version(),
        "eclipse-zenoh": version("eclipse-zenoh"),
        "lcm": version("lcm"),
        "router": router_kind(),
        "gateway": version_text(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit.stdout.strip() or "unknown",
    }


def load(file: Path) -> dict[str, Any]:
    """Return the results in the file, by part."""
    results: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    return results


def merge(file: Path, part: str, result: dict[str, Any]) -> None:
    """Store the result of one part in the file and keep those of the other parts."""
    results = load(file) | {part: {"machine": machine(), **result}}
    file.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")


def machines_table(results: dict[str, Any]) -> Table:
    """Return the table of machines, with one column for all parts measured on the same one."""
    names = list(dict.fromkeys(name for result in results.values() for name in result["machine"]))
    parts: dict[tuple[str, ...], list[str]] = {}
    for part, result in results.items():
        parts.setdefault(tuple(result["machine"].get(name, "") for name in names), []).append(part)
    rows = [[name, *(values[at] for values in parts)] for at, name in enumerate(names)]
    return Table("Machine", ["parts", *(", ".join(each) for each in parts.values())], rows)


def rendered(document: str, sections: dict[str, list[Table]]) -> str:
    """Return the document with each section's tables between its markers, if the document has them."""
    for name, tables in sections.items():
        text = "\n\n".join(table.markdown() for table in tables)
        before, start, rest = document.partition(f"<!-- {name} -->\n")
        _, end, after = rest.partition(f"<!-- end of {name} -->")
        if start and end:
            document = f"{before}{start}\n{text}\n\n{end}{after}"
    return document


class Pair:
    """The measured values of two alternately measured programs.

    The ratio of each pair of neighbouring runs is the first program's value divided by the second's.
    """

    def __init__(self, first: str, second: str) -> None:
        self._names = (first, second)
        self._values: dict[str, list[float]] = {first: [], second: []}

    @classmethod
    def of(cls, values: dict[str, list[float]]) -> Self:
        """Return the pair from which ``as_dict`` returned ``values``."""
        pair = cls(*values)
        pair._values = {name: list(each) for name, each in values.items()}
        return pair

    def as_dict(self) -> dict[str, list[float]]:
        """Return the values of both programs in the order of measurement, rounded to 5 digits."""
        return {name: [float(f"{value:.5g}") for value in each] for name, each in self._values.items()}

    def add(self, name: str, value: float) -> None:
        """Add the next value of one of the two programs."""
        self._values[name].append(value)

    def median(self, name: str) -> float:
        """Return the median of one program's values."""
        return statistics.median(self._values[name])

    @property
    def ratios(self) -> list[float]:
        """The ratios of all pairs of neighbouring runs."""
        first, second = (self._values[name] for name in self._names)
        return [one / other for one, other in zip(first, second, strict=True)]

    @property
    def ratio(self) -> float:
        """The median of the ratios."""
        return statistics.median(self.ratios)


def table_cell(pair: Pair) -> str:
    """Return the median ratio, and in brackets the smallest and the largest, as text."""
    return f"{pair.ratio:.2f} ({min(pair.ratios):.2f}–{max(pair.ratios):.2f})"


def percentile(values: Sequence[float], per_cent: float) -> float:
    """Return the smallest value that ``per_cent`` % of the values do not exceed (nearest rank)."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * per_cent / 100) - 1)]
