"""The folder of all takes: whether its disk accepts what is written, its limits, and the threads for it."""

import asyncio
import contextlib
import logging
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from gateway.errors import OutputError, QueryError, TakeError
from gateway.outputs.takes.folder import FileId, TakeEntry, TakesFolder, disk_problem
from gateway.outputs.takes.folder_clock import STEP_S, FolderClock
from gateway.outputs.takes.settings import TakesSettings
from gateway.runtime.failures import HOLD_S, FailureLog
from gateway.runtime.workers import WorkerThread, result_of
from gateway.takes.files.writer_thread import WriterThread

logger = logging.getLogger(__name__)


class Disk:
    """Remembers and logs the present problem of the disk. Called in the thread that writes."""

    def __init__(self) -> None:
        self.problem = ""
        """What is wrong and what to do; "" if the newest attempt succeeded, and after the end of a file."""
        self._failures = FailureLog(logger, "takes", HOLD_S)

    def failed(self, path: Path, error: OSError) -> None:
        """Note that ``path`` could not be written."""
        self.problem = disk_problem(path, error)
        self._failures.failed(self.problem, reason=error.strerror or "")

    def ended(self) -> None:
        """Forget the problem, because a file has ended; the next one shows whether it persists."""
        self.problem = ""

    def succeeded(self) -> None:
        """Note that something was written."""
        self.problem = ""
        self._failures.recovered("takes are written again")


_TIMEOUT_S: Final = 4.0
"""How long a peer waits for the disk."""

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Host:
    """The clocks and the threads that takes use; tests replace them."""

    monotonic: Callable[[], float] = time.monotonic
    wall: Callable[[], float] = time.time
    thread: Callable[[str], WorkerThread] = WorkerThread
    writer: Callable[[str, int], WriterThread] = WriterThread


async def disk_result(
    future: Future[_Result], path: Path, disk: Disk | None = None, late_code: str = "disk"
) -> _Result:
    """Return the result of a call that needs the disk of ``path``. Raises QueryError if the disk fails.

    ``disk`` knows why the thread that writes is late: for example, rolling segments wait for room.
    ``late_code`` is the code of the error if the call takes too long.
    """
    try:
        async with asyncio.timeout(_TIMEOUT_S):
            return await result_of(future)  # what was asked for happens later
    except TimeoutError:
        problem = "" if disk is None else disk.problem
        text = problem or f"the disk of {path} did not respond within {_TIMEOUT_S:g} s; check it"
        raise QueryError(text, code=late_code) from None
    except OSError as error:
        raise QueryError(disk_problem(path, error), code="disk") from error
    except TakeError as error:
        raise QueryError(str(error), code="disk") from error


_SILENT_S: Final = 5.0
"""How long a check of the folder may take; after that, the disk does not respond."""

_REST: Final = 50
"""After a check, the next one waits for this many times the duration of the check. After a problem, it does
not wait: the former gateway with this folder may just be ending."""

_DAY_S: Final = 86_400.0


_HISTORY_REST: Final = 3
"""After reading for a subscriber, the thread rests for this many times the CPU time: a quarter of a core.

Otherwise, peers that ask again and again would take Python's lock from the streams.
"""

MAX_HISTORY_READS: Final = 8
"""How many subscribers may wait for messages on the disk: it may not respond."""

_FRESH_S: Final = 5.0
"""A take that was written so recently is not deleted: it may have been started a moment ago."""

_EARLIEST_S: Final = 1_577_836_800.0
"""2020, before this program existed: an older take was written while the clock was not set, so its age is not
known."""


class _Noticed(NamedTuple):
    """When a take was written last: as its files say, and as the clock said then."""

    end_s: float
    written_s: float
    noticed_s: float | None
    """When that was noticed, on the monotonic clock; None if it was so before the first check."""
    noticed_wall_s: float


class FolderWatch:
    """Checks the folder of ``settings`` in a thread of its own, because its disk may not respond.

    The same thread deletes the oldest takes beyond the limits.
    """

    def __init__(self, settings: TakesSettings, host: Host) -> None:
        self._monotonic = host.monotonic
        self._wall = host.wall
        self.folder = TakesFolder(settings.effective_directory)
        self._clock = FolderClock(settings.effective_directory)
        self.is_checked = False
        """Whether it has been checked once."""
        self.excess_bytes = 0
        """By how much the folder was too large at the newest check, after deleting what may be deleted."""
        self._problem = f"{self.folder.directory} is not checked yet; does its disk respond?"
        self._thread = host.thread("takes-folder")
        self._check: Future[None] | None = None
        self._next_check_s = 0.0
        self._noticed: dict[Path, _Noticed] | None = None  # None before the first check

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

    def close(self) -> None:
        """Let another gateway use the folder, once no check is in progress."""
        self._thread.submit(self.folder.close)

    # In the thread.

    def _check_now(self, settings: TakesSettings, protected: AbstractSet[Path]) -> None:
        began_s = self._monotonic()
        problem, excess_bytes = self.folder.open(), 0
        if not problem:
            days = settings.max_age_days
            try:
                max_age_s = None if days is None else days * _DAY_S
                excess_bytes = self.delete_old(settings.max_bytes, max_age_s, protected)
            except OSError as error:
                problem = disk_problem(self.folder.directory, error)
        self._problem, self.excess_bytes, self.is_checked = problem, excess_bytes, True
        ended_s = self._monotonic()  # with thousands of takes, every second would keep a disk busy
        self._next_check_s = ended_s if problem else ended_s + _REST * (ended_s - began_s)

    def delete_old(self, max_bytes: int, max_age_s: float | None, protected: AbstractSet[Path]) -> int:
        """Delete the oldest takes beyond the limits, except the ``protected`` ones (paths without extension).

        If there are none of those, the newest take of each source stays: it may be the one that has just
        ended because of this limit. Returns how many bytes are still too many. Raises OSError.
        """
        entries = self.folder.entries()
        now_s = None if max_age_s is None else self._checked_time_s(entries)
        self._notice(entries)
        entries.sort(key=self._order)
        newest = {} if protected else {entry.source: entry.path for entry in entries}
        users: Counter[FileId] = Counter()
        sizes = self.folder.rolling_sizes()
        rolling = set(sizes)
        for entry in entries:
            sizes |= entry.sizes
            users.update(entry.sizes.keys())
        total = sum(sizes.values())
        for entry in entries:
            if entry.path in protected or self._is_fresh(entry):
                continue
            if max_age_s is not None and now_s is not None and self._age_s(entry, now_s) > max_age_s:
                reason = f"it is older than takes.max_age_days ({max_age_s / _DAY_S:g})"
            elif total > max_bytes and entry.path not in newest.values():
                reason = f"the folder has {total} bytes, and takes.max_bytes is {max_bytes}"
            else:
                continue
            for path, _ in (*entry.logs, *entry.c3d_files):
                path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # a file, or a folder in which somebody has put other files
                entry.path.rmdir()
            logger.info("takes: deleted %s, the oldest one: %s", entry.path, reason)
            for file, size in entry.sizes.items():
                users[file] -= 1
                if not users[file] and file not in rolling:
                    total -= size
        return max(0, total - max_bytes)

    def _notice(self, entries: Sequence[TakeEntry]) -> None:
        """Note when takes were written.

        The clock of the computer may be corrected by years at any time, so it counts only for takes from
        before the first check. If a clock that was behind is corrected, so are the times of the takes that
        were written with it: another gateway, which does not know about it, would find them too old.
        """
        former, self._noticed = self._noticed, {}
        wall_s, monotonic_s = self._wall(), self._monotonic()
        for entry in entries:
            noticed = None if former is None else former.get(entry.path)
            if noticed is None or noticed.end_s != entry.end_s:
                noticed_s = None if former is None else monotonic_s
                noticed = _Noticed(entry.end_s, entry.end_s, noticed_s, wall_s)
            if noticed.noticed_s is not None:
                age_s = monotonic_s - noticed.noticed_s
                end_s = max(wall_s, self._clock.latest_s) - age_s
                if abs(noticed.noticed_wall_s - noticed.written_s) < STEP_S <= abs(end_s - entry.end_s):
                    noticed = noticed._replace(end_s=_correct(entry, max(end_s, noticed.written_s)))
            self._noticed[entry.path] = noticed

    def _noticed_s(self, entry: TakeEntry) -> float | None:
        return None if self._noticed is None else self._noticed[entry.path].noticed_s

    def _order(self, entry: TakeEntry) -> tuple[float, float]:
        """Return the key that sorts takes, the oldest first.

        What is written now is newer than what was there before, even if that seems to be from the future:
        otherwise, each new take would be deleted before takes that are newer than the clock.
        """
        noticed_s = self._noticed_s(entry)
        return (-math.inf if noticed_s is None else noticed_s), entry.end_s

    def _is_fresh(self, entry: TakeEntry) -> bool:
        noticed_s = self._noticed_s(entry)
        if noticed_s is None:
            return abs(self._wall() - entry.end_s) < _FRESH_S
        return self._monotonic() - noticed_s < _FRESH_S

    def _checked_time_s(self, entries: Sequence[TakeEntry]) -> float:
        """Return the time from which the ages of takes count. Raises OSError."""
        wall_s = self._wall()
        newest_s = max((each.end_s for each in entries if each.end_s <= wall_s), default=wall_s)
        return self._clock.check(wall_s, self._monotonic(), newest_s)

    def _age_s(self, entry: TakeEntry, now_s: float) -> float:
        noticed_s = self._noticed_s(entry)
        if noticed_s is not None:
            return self._monotonic() - noticed_s
        return now_s - entry.end_s if entry.end_s >= _EARLIEST_S else 0.0


def _correct(entry: TakeEntry, end_s: float) -> float:
    """Set when a take was written last; return it as the file system rounds it. Raises OSError."""
    newest = max(entry.logs, key=lambda log: log[1].st_mtime)[0]
    os.utime(newest, (end_s, end_s))
    return newest.stat().st_mtime


class Storage:
    """What the takes of all sources share: their settings, their folder, its disk, and the threads for it.

    Call it in the event loop; no call waits for the disk for long.
    """

    def __init__(self, settings: TakesSettings, max_queued_bytes: int, host: Host) -> None:
        self.settings = settings
        self.host = host
        self.disk = Disk()
        self.watch = FolderWatch(settings, host)
        self.writer: WriterThread | None = None
        """The thread that writes; None before ``open``."""
        self.is_closed = False
        self.server: Callable[[str], str] = lambda _source: ""
        """Returns HOST:PORT of a source's server."""
        self.copy_thread = host.thread("takes-copy")
        self._read_thread = host.thread("takes-read")
        self._history_thread = host.thread("takes-history")
        self._num_history_reads = 0
        self._history_rest_until_s = 0.0
        self._max_queued_bytes = max_queued_bytes

    @property
    def folder(self) -> TakesFolder:
        """The folder of the takes."""
        return self.watch.folder

    def open(self) -> None:
        """Start to write."""
        self.writer = self.host.writer("takes", self._max_queued_bytes)
        self.writer.call(self.folder.recover)

    @property
    def problem(self) -> str:
        """What is wrong and what to do; "" if takes can be recorded."""
        if self.is_closed:
            return "the output takes is closed; start the gateway again"
        if self.writer is None:
            return "the output takes is not open; start it first"
        return self.watch.problem or self.disk.problem

    def started_writer(self) -> WriterThread:
        """Return the thread that writes. Raises QueryError if the output is not open."""
        if self.writer is None or self.is_closed:
            raise QueryError(self.problem, code="disk")
        return self.writer

    def open_writer(self) -> WriterThread:
        """Return the thread that writes. Raises QueryError if takes cannot be recorded now."""
        writer, problem = self.started_writer(), self.problem
        if problem and self.watch.is_checked:  # otherwise, creating the file shows it
            raise QueryError(problem, code="disk")
        return writer

    async def read(self, call: Callable[[], _Result], path: Path) -> _Result:
        """Return the result of ``call``, which reads ``path`` in a thread. Raises QueryError."""
        return await disk_result(self._read_thread.submit(call), path)

    async def read_history(self, call: Callable[[], _Result | None]) -> _Result | None:
        """Return the result of ``call``, which reads rolling segments in a thread.

        Raises QueryError, with the code busy if the disk does not respond in time: what it has is not lost.
        """
        if self._num_history_reads >= MAX_HISTORY_READS:
            raise QueryError("too many subscribers ask for messages on the disk; try again", code="busy")
        self._num_history_reads += 1
        is_wanted = True

        def read() -> _Result | None:
            if not is_wanted:
                return None
            time.sleep(max(0.0, self._history_rest_until_s - time.monotonic()))
            began_s = time.thread_time()
            try:
                return call()
            finally:
                rest_s = _HISTORY_REST * (time.thread_time() - began_s)
                self._history_rest_until_s = time.monotonic() + rest_s

        reading = self._history_thread.submit(read)
        reading.add_done_callback(self._end_history_read)
        try:
            return await disk_result(reading, self.folder.directory, late_code="busy")
        finally:
            is_wanted = False

    def _end_history_read(self, _reading: Future[Any]) -> None:
        self._num_history_reads -= 1

    async def written(self) -> None:
        """Wait until everything that was published so far is in the files.

        Raises QueryError, with the code busy if that takes too long.
        """
        writing = self.started_writer().call(lambda: None)
        await disk_result(writing, self.folder.directory, self.disk, late_code="busy")

    def refusal(self) -> OutputError | None:
        """Return the error for a message that is published while the output is not open."""
        problem = self.problem
        return OutputError(problem, cause="not open") if problem else None

    def queue_full(self) -> OutputError:
        """Return the error for a message that does not fit into the queue."""
        waiting_mib = self._max_queued_bytes / 2**20
        slow = (
            f"the disk of {self.folder.directory} is too slow: {waiting_mib:.0f} MiB wait for it; "
            "check what else writes to it"
        )
        return OutputError(self.problem or slow, cause="disk too slow")
