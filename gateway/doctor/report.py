"""How findings are shown: in colours and columns for people, as JSON for programs."""

import json
from collections.abc import Iterable
from typing import Final

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from gateway.doctor.finding import Finding, Result

_MARKS: Final = {
    Result.GREEN: ("ok", "bold green"),
    Result.RED: ("FAIL", "bold red"),
    Result.NOT_TESTED: ("skip", "yellow"),
}
_CHECK_WIDTH: Final = 10
_MAX_WIDTH: Final = 100


class Report:
    """Prints findings as they come, each subject below its name."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._subject = ""
        self.findings: list[Finding] = []

    def add(self, finding: Finding) -> None:
        """Print one finding."""
        self.findings.append(finding)
        if finding.subject != self._subject:
            self._subject = finding.subject
            self._console.print(Text(finding.subject, "bold"))
        mark, style = _MARKS[finding.result]
        text = "not tested: " if finding.result is Result.NOT_TESTED else ""
        row = Table.grid(padding=(0, 2))
        row.add_column(width=4)
        row.add_column(width=_CHECK_WIDTH)
        row.add_column(overflow="fold")
        row.add_row(Text(mark, style), finding.check, Text(text + finding.found))
        if finding.remedy:
            row.add_row("", "", Text(f"→ {finding.remedy}", "bold"))
        self._console.print(Padding(row, (0, 0, 0, 2)), width=min(self._console.width, _MAX_WIDTH))

    def end(self) -> None:
        """Print how many of each there are."""
        counts = {result: sum(each.result is result for each in self.findings) for result in Result}
        text = (
            f"{counts[Result.GREEN]} ok, {counts[Result.RED]} to put right, "
            f"{counts[Result.NOT_TESTED]} not tested"
        )
        self._console.print(Text(text, "bold red" if counts[Result.RED] else "bold green"))


def as_json(findings: Iterable[Finding]) -> str:
    """Return the findings as a JSON object: ok, and findings with subject, check, result, found, remedy."""
    listed = list(findings)
    is_ok = all(finding.result is not Result.RED for finding in listed)
    objects = [{**finding._asdict(), "result": finding.result.value} for finding in listed]
    return json.dumps({"ok": is_ok, "findings": objects}, indent=2, ensure_ascii=False)
