"""Whether the disk accepts what is written to it."""

import asyncio
import errno
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from gateway.errors import QueryError, TakeError
from gateway.logs.failures import HOLD_S, FailureLog
from gateway.takes.files.writer_thread import WriterThread
from gateway.workers import WorkerThread, result_of

_REMEDIES: Final = {
    errno.ENOSPC: "make room on it, or lower takes.max_bytes",
    errno.EDQUOT: "make room on it, or lower takes.max_bytes",
    errno.EACCES: "let the gateway write there",
    errno.EPERM: "let the gateway write there",
    errno.EROFS: "mount it so that the gateway can write",
    errno.ENOENT: "is the disk mounted? If so, create the folder, or start the gateway again",
    errno.ENOTDIR: "choose a folder as takes.directory",
}

logger = logging.getLogger(__name__)


def is_full(error: OSError) -> bool:
    """Return whether room on the disk would help."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


class Disk:
    """Remembers and logs the present problem of the disk. Called in the thread that writes."""

    def __init__(self) -> None:
        self.problem = ""
        """What is wrong and what to do; "" if the newest attempt succeeded, and after the end of a file."""
        self._failures = FailureLog(logger, "takes", HOLD_S)

    def failed(self, path: Path, error: OSError) -> None:
        """Note that ``path`` could not be written."""
        self.problem = disk_problem(path, error)
        self._failures.failed(self.problem)

    def ended(self) -> None:
        """Forget the problem, because a file has ended; the next one shows whether it persists."""
        self.problem = ""

    def succeeded(self) -> None:
        """Note that something was written."""
        self.problem = ""
        self._failures.recovered("takes are written again")


def disk_problem(path: Path, error: OSError) -> str:
    """Return what is wrong with ``path``, and what to do."""
    remedy = _REMEDIES.get(error.errno or 0, "check the disk")
    return f"{path} cannot be written: {error.strerror or error}; {remedy}"


_TIMEOUT_S: Final = 4.0
"""How long a peer waits for the disk."""

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Host:
    """The clock and the threads that takes use; tests replace them."""

    monotonic: Callable[[], float] = time.monotonic
    thread: Callable[[str], WorkerThread] = WorkerThread
    writer: Callable[[str, int], WriterThread] = WriterThread


async def disk_result(future: Future[_Result], path: Path, disk: Disk | None = None) -> _Result:
    """Return the result of a call that needs the disk of ``path``. Raises QueryError if the disk fails.

    ``disk`` knows why the thread that writes is late: for example, rolling segments wait for room.
    """
    try:
        async with asyncio.timeout(_TIMEOUT_S):
            return await result_of(future)  # what was asked for happens later
    except TimeoutError:
        problem = "" if disk is None else disk.problem
        text = problem or f"the disk of {path} did not respond within {_TIMEOUT_S:g} s; check it"
        raise QueryError(text, code="disk") from None
    except OSError as error:
        raise QueryError(disk_problem(path, error), code="disk") from error
    except TakeError as error:
        raise QueryError(str(error), code="disk") from error
