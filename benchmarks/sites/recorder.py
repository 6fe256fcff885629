"""``rtc3d-gateway record`` on a site, and what is in its recordings."""

import re
import subprocess
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from benchmarks import processes
from benchmarks.processes import ROOT
from benchmarks.sites.two_sites import Site
from gateway.messages.history import sequence_of, utime_of
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.takes.files.reader import TakeReader

_END_S: Final = 30.0
_EDGE_US: Final = 500_000
"""How long before its last message a recording may lack others."""


class _Message(NamedTuple):
    utime: int
    sequence: int
    content: int
    """The hash of the message."""


@dataclass(frozen=True)
class Recording:
    """How ``record`` ended, and what is in its file."""

    status: int
    """The exit status: 0 if ``record`` says that the recording is complete."""
    summary: str
    """The table that ``record`` prints, and what is missing."""
    refilled: int
    """How many messages came from the history of the gateway, as ``record`` says."""
    messages: dict[tuple[str, str], list[_Message]]
    """The messages of each source and component, in order; read from the file, whatever ``record`` says."""

    def gaps(self) -> int:
        """Return how many numbers are missing. Where they begin again, a gateway was restarted."""
        steps = (
            now.sequence - before.sequence
            for series in self.messages.values()
            for before, now in pairwise(series)
        )
        return sum(step - 1 for step in steps if step > 0)

    def differs_from(self, other: Self) -> int:
        """Return how many messages of the time that both recorded are missing in one, or are different.

        It begins when both have the first message of each series: before, neither can know what is missing.
        """
        recordings = (self, other)
        first = max(series[0].utime for each in recordings for series in each.messages.values())
        last = min(
            max(series[-1].utime for series in each.messages.values()) - _EDGE_US for each in recordings
        )
        both = (
            {
                (key, message)
                for key, series in each.messages.items()
                for message in series
                if first <= message.utime <= last
            }
            for each in recordings
        )
        return len(set.symmetric_difference(*both))

    def figures(self) -> dict[str, Any]:
        """Return what the results have of it."""
        gaps = self.gaps()
        return {
            "complete": self.status == 0 and not gaps,
            "messages": sum(map(len, self.messages.values())),
            "gaps": gaps,
            "refilled": self.refilled,
            **({"says": self.summary} if self.status else {}),
        }


class Recorder:
    """A context in which ``record`` writes what it receives through the router of its site to a new file."""

    def __init__(self, site: Site, file: Path) -> None:
        self._file = file
        self._command = site.command("record", str(file), "--quiet")

    def __enter__(self) -> Self:
        """Start it, and wait until it has begun to write."""
        self._process = subprocess.Popen(  # noqa: S603 - the command is our own
            self._command, cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        processes.wait_until(
            lambda: self._process.poll() is not None or self._has_begun(), "the recording begins"
        )
        return self

    def _has_begun(self) -> bool:
        return self._file.exists() and self._file.stat().st_size > 0

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()

    def stop(self) -> Recording:
        """Stop it, and return what it has recorded."""
        self._process.terminate()
        summary, _ = self._process.communicate(timeout=_END_S)
        return Recording(self._process.returncode, summary, _refilled(summary), _messages(self._file))


def figures_text(figures: dict[str, Any]) -> str:
    """Return whether a recording is complete, and how much of it came from the history."""
    is_complete = "complete" if figures["complete"] else f"**{figures['gaps']} missing**"
    return f"{is_complete}, {figures['refilled']} refilled"


def _refilled(summary: str) -> int:
    """Return the sum of the column "refilled" of the table."""
    rows = re.findall(r"Hz +([\d-]+) +[\d-]+ +[\d-]+$", summary, re.MULTILINE)
    return sum(int(each) for each in rows if each != "-")


def _messages(file: Path) -> dict[tuple[str, str], list[_Message]]:
    found: dict[tuple[str, str], list[_Message]] = defaultdict(list)
    for batches in TakeReader(file).batches():
        for batch in batches:
            if batch.key in COMPONENTS_BY_KEY:
                found[batch.source, batch.key] += [
                    _Message(utime_of(message), sequence_of(message), hash(message))
                    for message in batch.messages
                ]
    return found
