"""How findings are shown: in colours and columns for people, as JSON for programs."""

import json
import textwrap
from typing import Final

from rich.console import Console
from rich.text import Text

from gateway.doctor.finding import Finding, Result

_MARKS: Final = {
    Result.GREEN: ("ok", "bold green"),
    Result.RED: ("FAIL", "bold red"),
    Result.NOT_TESTED: ("skip", "yellow"),
}
_INDENT: Final = " " * 20
"""Where texts begin: behind the mark, in column 3, and the check's name, in column 9."""

_MAX_WIDTH: Final = 100


class Report:
    """Prints findings as they come, each subject's below its name."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._subject = ""
        self.findings: list[Finding] = []

    def add(self, finding: Finding) -> None:
        """Print one finding."""
        self.findings.append(finding)
        if finding.subject != self._subject:
            self._subject = finding.subject
            self._print(Text(finding.subject, "bold"))
        mark, style = _MARKS[finding.result]
        begin = Text.assemble("  ", (f"{mark:<4}", style), f"  {finding.check:<12}")
        text = "not tested: " if finding.result is Result.NOT_TESTED else ""
        first, *others = self._wrapped(text + finding.found)
        self._print(begin + Text(first))
        for line in others:
            self._print(Text(_INDENT + line))
        for number, line in enumerate(self._wrapped(finding.remedy)):
            self._print(Text(_INDENT + ("→ " if number == 0 else "  ") + line, "bold"))

    def end(self) -> None:
        """Print how many of each there are."""
        counts = {result: sum(each.result is result for each in self.findings) for result in Result}
        text = (
            f"{counts[Result.GREEN]} ok, {counts[Result.RED]} to put right, "
            f"{counts[Result.NOT_TESTED]} not tested"
        )
        self._print(Text(text, "bold green" if self.is_good else "bold red"))

    @property
    def is_good(self) -> bool:
        """Whether nothing is red."""
        return all(finding.result is not Result.RED for finding in self.findings)

    def as_json(self) -> str:
        """Return one object: ok, and findings with subject, check, result, found and remedy."""
        findings = [{**finding._asdict(), "result": finding.result.value} for finding in self.findings]
        return json.dumps({"ok": self.is_good, "findings": findings}, indent=2, ensure_ascii=False)

    def _wrapped(self, text: str) -> list[str]:
        """Return the lines of ``text``; paths and addresses stay whole, to be copied."""
        width = max(20, min(self._console.width, _MAX_WIDTH) - len(_INDENT) - 2)
        return [
            line
            for part in text.splitlines()
            for line in textwrap.wrap(part, width, break_long_words=False, break_on_hyphens=False)
        ]

    def _print(self, text: Text) -> None:
        self._console.print(text, soft_wrap=True)
