"""Watching the folder of takes: whether it can be written, and its limits."""

from collections.abc import Set as AbstractSet
from concurrent.futures import Future
from pathlib import Path
from typing import Final

from gateway.outputs.takes.disk import Host, disk_problem
from gateway.outputs.takes.folder import TakesFolder
from gateway.outputs.takes.settings import TakesSettings

_SILENT_S: Final = 5.0
"""How long a check of the folder may take; after that, the disk does not respond."""

_REST: Final = 50
"""After a check, the next one waits for this many times the duration of the check. After a problem, it does
not wait: the former gateway with this folder may just be ending."""

_DAY_S: Final = 86_400.0


class FolderWatch:
    """Checks the folder of ``settings`` in a thread of its own, because its disk may not respond."""

    def __init__(self, settings: TakesSettings, host: Host) -> None:
        self._monotonic = host.monotonic
        self.folder = TakesFolder(settings.effective_directory, host.monotonic)
        self.is_checked = False
        """Whether it has been checked once."""
        self.excess_bytes = 0
        """By how much the folder was too large at the newest check, after deleting what may be deleted."""
        self._problem = f"{self.folder.directory} is not checked yet; does its disk respond?"
        self._thread = host.thread("takes-folder")
        self._check: Future[None] | None = None
        self._next_check_s = 0.0

    @property
    def problem(self) -> str:
        """What is wrong with the folder and what to do; "" if takes can be recorded there."""
        if self._thread.call_age_s > _SILENT_S:
            return (
                f"the disk of {self.folder.directory} does not respond; check it, and whether it is mounted"
            )
        return self._problem

    def check(self, settings: TakesSettings, protected: AbstractSet[Path]) -> None:
        """Check the folder and keep its limits, unless that was done a moment ago.

        ``protected`` are the paths, without extension, of the takes that must not be deleted.
        """
        if (self._check is None or self._check.done()) and self._monotonic() >= self._next_check_s:
            self._check = self._thread.submit(lambda: self._check_now(settings, protected))

    def _check_now(self, settings: TakesSettings, protected: AbstractSet[Path]) -> None:
        began_s = self._monotonic()
        problem, excess_bytes = self.folder.open(), 0
        if not problem:
            days = settings.max_age_days
            try:
                excess_bytes = self.folder.delete_old(
                    max_bytes=settings.max_bytes,
                    max_age_s=None if days is None else days * _DAY_S,
                    protected=protected,
                )
            except OSError as error:
                problem = disk_problem(self.folder.directory, error)
        self._problem, self.excess_bytes, self.is_checked = problem, excess_bytes, True
        ended_s = self._monotonic()  # with thousands of takes, every second would keep a disk busy
        self._next_check_s = ended_s if problem else ended_s + _REST * (ended_s - began_s)

    def close(self) -> None:
        """Let another gateway use the folder, once no check is in progress."""
        self._thread.submit(self.folder.close)
