"""Native subscribers: many sessions in a few processes, which count what they receive and miss."""

import contextlib
import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import IO, Any, Final, Self

from benchmarks.processes import ROOT, tree_cpu_s, zenoh_session_config
from benchmarks.sites.network import Namespace
from gateway.rtc3d.components import COMPONENTS_BY_KEY

PROGRAM: Final = ROOT / "build" / "native" / "release" / "site-subscriber"
ALL_KEYS: Final = ("mocap/*/*",)
"""The key expressions of a subscriber to everything except poses of single tools."""

_PER_PROCESS: Final = 32
_END_S: Final = 10.0
_QUIET_S: Final = 1.0


Reports = dict[str, dict[str, Any]]
"""What one session has received, by key, as the program reports it."""


@dataclass
class Received:
    """What one or more sessions have received on some keys."""

    messages: int = 0
    message_bytes: int = 0
    missing: int = 0
    """Gaps in ``sequence``; what a later message has not shown to be missing does not count."""
    not_newer: int = 0
    longest_silence_ms: float = 0.0
    ages_us: Counter[float] = field(default_factory=Counter)
    """How old each message was when it arrived, since ``utime``: upper edges of a histogram, and counts."""
    ages_before_us: Counter[float] = field(default_factory=Counter)
    """How old the newest message had become when the next one arrived."""

    def add(self, report: dict[str, Any]) -> None:
        """Add what the program reports about one key."""
        self.messages += report["messages"]
        self.message_bytes += report["message_bytes"]
        self.missing += report["missing"]
        self.not_newer += report["not_newer"]
        self.ages_us.update(dict(report["ages_us"]))
        self.ages_before_us.update(dict(report["ages_before_us"]))


def percentile_ms(ages_us: Counter[float], per_cent: float) -> float:
    """Return the smallest age that ``per_cent`` % do not exceed, in ms; at most 4.4 % too large."""
    left = ages_us.total() * per_cent / 100
    for age_us, count in sorted(ages_us.items()):
        left -= count
        if left <= 0:
            return age_us / 1000
    return 0.0


class Subscribers:
    """A context in which ``count`` sessions subscribe to ``keys`` through the router of their site."""

    def __init__(self, site: Namespace, endpoint: str, count: int, keys: Sequence[str]) -> None:
        config = json.dumps(zenoh_session_config("client", connect=[endpoint]))
        python = [sys.executable, "-m", "benchmarks.sites.python_subscriber"]
        program = [str(PROGRAM)] if PROGRAM.exists() else python
        self._commands = [
            site.command(*program, config, str(min(_PER_PROCESS, count - first)), *keys)
            for first in range(0, count, _PER_PROCESS)
        ]

    def __enter__(self) -> Self:
        self._processes = [
            subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)  # noqa: S603
            for command in self._commands
        ]
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            with contextlib.suppress(BrokenPipeError):  # it has ended early
                _pipe(process.stdin).close()
        for process in self._processes:
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            _pipe(process.stdout).close()

    def cpu_s(self) -> float:
        """Return the CPU time of all sessions, in s."""
        return sum(tree_cpu_s(process.pid) for process in self._processes)

    def look(self) -> list[Reports]:
        """Return what each session has received of each key since ``take``."""
        return self._ask("look")

    def take(self) -> list[Reports]:
        """Return the same as ``look``, and start to count again."""
        return self._ask("take")

    def _ask(self, request: str) -> list[Reports]:
        for process in self._processes:
            _pipe(process.stdin).write(f"{request}\n")
            _pipe(process.stdin).flush()
        sessions: list[Reports] = []
        for process in self._processes:
            line = _pipe(process.stdout).readline()
            if not line:
                raise RuntimeError("a subscriber has ended; its error is above")
            sessions += json.loads(line)
        return sessions

    def wait_for(self, messages: int) -> list[Reports]:
        """Wait until all sessions have this many messages of components, or none arrive for a second.

        Return the same as ``take``.
        """
        before = -1
        while before < (now := received(self.look()).messages) < messages:
            before = now
            time.sleep(_QUIET_S)
        return self.take()


def _pipe(stream: IO[str] | None) -> IO[str]:
    if stream is None:
        raise RuntimeError("the process has no pipe")
    return stream


def received(sessions: Iterable[Reports], source: str = "") -> Received:
    """Return the sum of what sessions have received of the components of one source, or of all."""
    total = Received()
    for session in sessions:
        for key, report in session.items():
            if is_component(key) and source in ("", key.split("/")[-2]):
                total.add(report)
                if not key.endswith("/event"):  # events are rare
                    silence_ms = report["longest_silence_us"] / 1000
                    total.longest_silence_ms = max(total.longest_silence_ms, silence_ms)
    return total


def is_component(key: str) -> bool:
    """Return whether messages of a component have this key; it may be one of several sources."""
    return key.rpartition("/")[2] in COMPONENTS_BY_KEY
