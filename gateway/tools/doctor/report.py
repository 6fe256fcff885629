"""The doctor's report: columns and colours for people, JSON for programs."""

import json
import textwrap
from collections import Counter
from typing import Final

from rich.console import Console
from rich.text import Text

from gateway.outputs.findings import Finding, Result
from gateway.runtime.quantities import counted
from gateway.runtime.safe_text import safe_json, safe_lines

_MARKS: Final = {
    Result.PASSING: ("ok", "bold green"),
    Result.NOTE: ("note", "cyan"),
    Result.WARNING: ("warn", "bold yellow"),
    Result.FAILING: ("FAIL", "bold red"),
    Result.NOT_TESTED: ("skip", "yellow"),
}
_INDENT: Final = " " * 20
"""The indentation of texts: the mark begins in column 3, the name of the check in column 9."""

_MAX_WIDTH: Final = 100

_DISABLED: Final = "outputs that are not enabled"
"""The subject under which these outputs are listed."""

_OTHERS: Final = "sources and outputs"
_AFTER_CONFIGURATION: Final = "correct the configuration first, then run the doctor again"
"""The one line for all checks that need a valid configuration."""


class Report:
    """Prints each finding when it is added, under the name of its subject.

    An output that is not enabled gets one line for all of its checks, and so do all checks that need a valid
    configuration while there is none. If the report is ``quiet``, it prints only warnings and failures.
    """

    def __init__(self, console: Console, *, quiet: bool = False) -> None:
        self._console = console
        self._quiet = quiet
        self._subject = ""
        self._one_line: set[tuple[str, str]] = set()  # printed for several findings
        self.findings: list[Finding] = []

    def add(self, finding: Finding) -> None:
        """Add and print one finding."""
        self.findings.append(finding)
        if self._quiet and finding.result not in {Result.WARNING, Result.FAILING}:
            return
        subject = f"{finding.subject} ({finding.stream})" if finding.stream else finding.subject
        check, found = finding.check, finding.found
        if finding.is_of_disabled_output or finding.lacks_configuration:
            if finding.lacks_configuration:
                subject, check, found = _OTHERS, "all", _AFTER_CONFIGURATION
            else:
                subject, check = _DISABLED, finding.subject
            if (subject, check) in self._one_line:
                return
            self._one_line.add((subject, check))
        if subject != self._subject:
            self._subject = subject
            self._print(Text(subject, "bold"))
        mark, style = _MARKS[finding.result]
        columns = Text.assemble("  ", (f"{mark:<4}", style), f"  {check:<12}")
        text = "not tested: " if finding.result is Result.NOT_TESTED else ""
        first, *others = self._wrapped(text + found)
        self._print(columns + Text(first))
        for line in others:
            self._print(Text(_INDENT + line))
        for number, line in enumerate(self._wrapped(finding.remedy)):
            self._print(Text(_INDENT + ("→ " if number == 0 else "  ") + line, "bold"))

    def end(self) -> None:
        """Print how many checks passed, failed and were not tested, and how many warnings and notes.

        Checks of outputs that are not enabled are not counted.
        """
        if self._quiet:
            return
        counts = Counter(each.result for each in self.findings if not each.is_of_disabled_output)
        text = (
            f"{counts[Result.PASSING]} ok, {counts[Result.FAILING]} failed, "
            f"{counts[Result.NOT_TESTED]} not tested"
        )
        for result in (Result.WARNING, Result.NOTE):
            if counts[result]:
                text += f", {counted(counts[result], result.value)}"
        passed_style = "bold yellow" if counts[Result.WARNING] else "bold green"
        self._print(Text(text, passed_style if self.is_ok else "bold red"))

    @property
    def is_ok(self) -> bool:
        """Whether no check failed."""
        return all(finding.result is not Result.FAILING for finding in self.findings)

    def as_json(self) -> str:
        """Return a JSON object: ok, and findings with subject, check, result, found and remedy.

        A finding has ``stream`` only if its source has several.
        """
        findings = [
            {
                name: value
                for name, value in {**finding._asdict(), "result": finding.result.value}.items()
                if name != "stream" or value
            }
            for finding in self.findings
        ]
        return safe_json(json.dumps({"ok": self.is_ok, "findings": findings}, indent=2, ensure_ascii=False))

    def _wrapped(self, text: str) -> list[str]:
        """Wrap ``text`` into lines. Paths and addresses are not split, so that they can be copied."""
        width = max(20, min(self._console.width, _MAX_WIDTH) - len(_INDENT) - 2)
        return [
            line
            for paragraph in safe_lines(text).split("\n")
            for line in textwrap.wrap(paragraph, width, break_long_words=False, break_on_hyphens=False)
        ]

    def _print(self, text: Text) -> None:
        self._console.print(text, soft_wrap=True)
