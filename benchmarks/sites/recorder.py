"""``rtc3d-gateway record`` on a site, and what is in its recordings."""

import re
import signal
import subprocess
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from benchmarks import processes
from benchmarks.processes import ROOT
from benchmarks.sites.two_sites import Site
from gateway.messages.history import sequence_of
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.takes.files.reader import TakeReader

_END_S: Final = 30.0


@dataclass(frozen=True)
class Recording:
    """How ``record`` ended, and what is in its file."""

    status: int
    """The exit status: 0 if ``record`` says that the recording is complete."""
    summary: str
    refilled: int
    """How many messages came from the history of the gateway, as ``record`` says."""
    messages: dict[tuple[str, str, int], dict[int, int]]
    """The hash of each message by its ``sequence``, for each source, component and run of its gateway.

    They are read from the file, so they do not depend on what ``record`` says.
    """

    def gaps(self) -> int:
        """Return how many numbers are missing between the first and the last of each source and component."""
        return sum(1 + max(each) - min(each) - len(each) for each in self.messages.values())

    def differs_from(self, other: Self) -> int:
        """Return how many messages of the time that both recorded are missing in one, or are different."""
        count = 0
        for key in self.messages.keys() | other.messages.keys():
            one, two = self.messages.get(key, {}), other.messages.get(key, {})
            if not one or not two:
                count += len(one) + len(two)
                continue
            both = range(max(min(one), min(two)), min(max(one), max(two)) + 1)
            count += sum(one.get(number) != two.get(number) for number in both)
        return count

    def figures(self) -> dict[str, Any]:
        """Return what the results have of it."""
        gaps = self.gaps()
        return {
            "complete": self.status == 0 and not gaps,
            "messages": sum(map(len, self.messages.values())),
            "gaps": gaps,
            "refilled": self.refilled,
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
            self._process.wait()

    def stop(self) -> Recording:
        """Stop it as Ctrl-C does, and return what it has recorded."""
        self._process.send_signal(signal.SIGINT)
        summary, _ = self._process.communicate(timeout=_END_S)
        return Recording(
            self._process.returncode, summary, _refilled(summary), _hashes_by_sequence(self._file)
        )


def figures_text(figures: dict[str, Any]) -> str:
    """Return whether a recording is complete, and how much of it came from the history."""
    is_complete = "complete" if figures["complete"] else f"**{figures['gaps']} missing**"
    return f"{is_complete}, {figures['refilled']} refilled"


def _refilled(summary: str) -> int:
    """Return the sum of the column "refilled" of the table."""
    rows = re.findall(r"Hz +([\d-]+) +[\d-]+ +[\d-]+$", summary, re.MULTILINE)
    return sum(int(each) for each in rows if each != "-")


def _hashes_by_sequence(file: Path) -> dict[tuple[str, str, int], dict[int, int]]:
    found: dict[tuple[str, str, int], dict[int, int]] = {}
    runs: Counter[tuple[str, str]] = Counter()
    newest: dict[tuple[str, str], int] = {}
    for batches in TakeReader(file).batches():
        for batch in batches:
            if batch.key not in COMPONENTS_BY_KEY:
                continue
            key = (batch.source, batch.key)
            for message in batch.messages:
                sequence = sequence_of(message)
                if sequence <= newest.get(key, -1):  # messages are in order, unless the numbers began again
                    runs[key] += 1
                newest[key] = sequence
                found.setdefault((*key, runs[key]), {})[sequence] = hash(message)
    return found
