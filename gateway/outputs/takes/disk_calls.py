"""The clock and the threads of takes, and waiting for calls that need the disk, on behalf of peers."""

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from gateway.errors import QueryError, TakeError
from gateway.outputs.takes.disk import Disk, disk_problem
from gateway.takes.recording import Recorder
from gateway.worker_thread import WorkerThread, result_of

_TIMEOUT_S: Final = 4.0
"""How long a peer waits for the disk."""

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Host:
    """The clock and the threads that takes use; tests replace them."""

    monotonic: Callable[[], float] = time.monotonic
    thread: Callable[[str], WorkerThread] = WorkerThread
    recorder: Callable[[str, int], Recorder] = Recorder


class DiskReader:
    """Reads the disk for peers in a thread."""

    def __init__(self, thread: WorkerThread) -> None:
        self._thread = thread

    async def read(self, call: Callable[[], _Result], path: Path) -> _Result:
        """Return the result of ``call``, which reads ``path``. Raises QueryError."""
        return await disk_result(self._thread.submit(call), path)


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
