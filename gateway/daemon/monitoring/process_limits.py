"""What may stop the gateway: limits of the system, memory, a late event loop, full disks, certificates."""

import asyncio
import contextlib
import ctypes
import errno
import logging
import os
import resource
import shutil
import ssl
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from gateway.config.files import read_file
from gateway.config.settings import OutputSettings
from gateway.daemon.gateway import Gateway
from gateway.errors import FILES_ADVICE, NO_FILES, ConfigError
from gateway.outputs.takes.settings import TakesSettings
from gateway.runtime.failures import HOLD_S, FailureLog
from gateway.runtime.workers import WorkerThread, thread_starts
from gateway.session.process_clock import running_clock

MAX_FILES: Final = 65_536
"""How many files the gateway wants to open at most: more than the clients that its outputs accept."""

_MAX_ARENAS: Final = 2
_M_ARENA_MAX: Final = -8
"""The parameter of mallopt(3) that limits the number of arenas."""

_LARGE_BLOCK_BYTES: Final = 1 << 20
_M_MMAP_THRESHOLD: Final = -3
"""The parameter of mallopt(3) from which size on a block is returned to the system when it is freed."""

logger = logging.getLogger(__name__)


def raise_file_limit() -> None:
    """Let the process open as many files as the system allows it, at most MAX_FILES.

    The limit that programs start with is usually 1024, for the sake of programs that use select().
    """
    with contextlib.suppress(OSError, ValueError):  # a sandbox may forbid it
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def limit_kept_memory() -> None:
    """Let malloc keep less of what is freed. Call it before Zenoh starts.

    The threads share two arenas, so that they reuse each other's memory. glibc gives them up to eight per
    core, and returns little of what they free: floods of queries and hundreds of reloads left up to three
    times the memory behind. Large blocks, such as the answer with a C3D file, are returned at once: glibc
    raises its threshold to the largest block freed, and a peer that asked for files left up to 40 MiB behind.
    """
    with contextlib.suppress(AttributeError):  # another libc, which has no arenas
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_ARENA_MAX, _MAX_ARENAS)
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK_BYTES)


def return_free_memory() -> None:
    """Return to the system what glibc keeps of freed memory. Call it in a thread, for it may take 0.3 s.

    glibc keeps what is free between blocks in use: 215 of its 250 MiB after an hour of attacks. Threads that
    allocate meanwhile waited for up to 0.07 s to return 300 MiB on a busy machine.
    """
    with contextlib.suppress(AttributeError):  # another libc
        ctypes.CDLL(None).malloc_trim(0)


class ProcessLimits:
    """Finds out what the system refuses now, and logs when that begins and ends."""

    def __init__(self) -> None:
        self._files = FailureLog(logger, "gateway", HOLD_S)
        self._threads = FailureLog(logger, "gateway", HOLD_S)

    def problems(self) -> list[str]:
        """Return what the system refuses now, and what to do. Call it once a second, or more often."""
        problems = []
        for failures, problem, recovery in (
            (self._files, _file_problem(), "files can be opened again"),
            (self._threads, _thread_problem(), "threads can be started again"),
        ):
            if problem:
                failures.failed(problem)
                problems.append(problem)
            else:
                failures.recovered(recovery)
        return problems


def _file_problem() -> str:
    try:
        os.close(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        if error.errno == errno.ENFILE:
            return (
                "the computer has no file descriptor left, so nobody can connect, and no file can be opened; "
                "end programs that have many files open, or raise fs.file-max"
            )
        if error.errno in NO_FILES:
            most = ""
            with contextlib.suppress(OSError):  # a sandbox may forbid it
                most = f" {resource.getrlimit(resource.RLIMIT_NOFILE)[0]}"
            return (
                f"all{most} file descriptors of the gateway are in use, so nobody can connect, and no file "
                f"can be opened; {FILES_ADVICE}"
            )
    return ""


def _thread_problem() -> str:
    thread_starts.check()
    if not thread_starts.is_failing:
        return ""
    try:
        num_threads = len([*Path("/proc/self/task").iterdir()])
    except OSError:
        num_threads = threading.active_count()
    return (
        f"no further thread can be started beside the {num_threads} of the gateway "
        f"({thread_starts.num_failed} attempts failed), so parts of it do not work; end other programs of "
        "its user, or let it have more (TasksMax of the service)"
    )


_PERIOD_S: Final = 1.0
"""Each measurement wakes the process, which costs as much CPU time as a frame."""

_WINDOW_S: Final = 60.0


class LoopDelay:
    """Measures every second how late a timer fires, and takes over longer delays from the running clock.

    Call ``start`` in the running event loop.
    """

    def __init__(self) -> None:
        self.last_s = 0.0
        """The delay of the newest measurement."""
        self._max_s = self._previous_max_s = 0.0  # of this minute and of the one before
        self._window_end_s = self._due_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    @property
    def max_s(self) -> float:
        """The largest delay of the last one to two minutes, so a scrape each minute misses none."""
        return max(self._max_s, self._previous_max_s)

    def start(self) -> None:
        """Start measuring."""
        running_clock()  # measures from now on
        self._window_end_s = time.monotonic() + _WINDOW_S
        self._schedule()

    def close(self) -> None:
        """Stop measuring."""
        if self._timer is not None:
            self._timer.cancel()

    def record(self, now_s: float, delay_s: float) -> None:
        """Add one measurement, made at ``now_s`` on the monotonic clock."""
        self.last_s = delay_s
        if now_s >= self._window_end_s:
            self._previous_max_s, self._max_s = self._max_s, 0.0
            self._window_end_s = now_s + _WINDOW_S
        self._max_s = max(self._max_s, delay_s)

    def _schedule(self) -> None:
        # time.monotonic, because uvloop's own clock counts whole milliseconds
        self._due_s = time.monotonic() + _PERIOD_S
        self._timer = asyncio.get_running_loop().call_later(_PERIOD_S, self._measure)

    def _measure(self) -> None:
        now_s = time.monotonic()
        self.record(now_s, max(0.0, now_s - self._due_s))  # uvloop's timers may be up to 1 ms early
        self._max_s = max(self._max_s, running_clock().longest_delay_s(2 * _PERIOD_S))
        self._schedule()


_DISK_PERIOD_S: Final = 60.0
_PEM_BEGIN: Final = "-----BEGIN CERTIFICATE-----"
_PEM_END: Final = "-----END CERTIFICATE-----"
_SEQUENCE: Final = 0x30
_VERSION: Final = 0xA0
_UTC_TIME: Final = 0x17


class DiskFacts:
    """What metrics need from disks: when certificates end, and how much room there is for takes.

    A disk may not respond, so all of this is read in a thread, once a minute, until ``close``. What cannot be
    read is left out.
    """

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._task: asyncio.Task[None] | None = None
        self.certificate_ends_s: Mapping[tuple[str, str], float] = {}
        """When certificates end, in s since the Unix epoch, by output and the key that names them."""
        self.takes_free_bytes: int | None = None
        """The room on the disk of the takes; None if the output is off."""

    def start(self) -> None:
        """Start reading, in the running event loop."""
        self._task = asyncio.create_task(self._read())

    def close(self) -> None:
        """Stop reading."""
        if self._task is not None:
            self._task.cancel()

    async def _read(self) -> None:
        thread = WorkerThread("disk-facts")
        while True:
            with contextlib.suppress(OSError):  # no thread can be started: the health says so
                settings = self._gateway.settings.outputs
                self.certificate_ends_s, self.takes_free_bytes = await thread.run(
                    partial(_disk_facts, settings)
                )
            await asyncio.sleep(_DISK_PERIOD_S)


def _disk_facts(outputs: Mapping[str, OutputSettings]) -> tuple[Mapping[tuple[str, str], float], int | None]:
    """Return what DiskFacts knows, in the same order. This may take long."""
    ends_s: dict[tuple[str, str], float] = {}
    free_bytes: int | None = None
    for name, settings in outputs.items():
        if not settings.enabled:
            continue
        certificates: Mapping[str, Path] = {}
        with contextlib.suppress(ConfigError):  # the file has changed since the gateway started
            certificates = settings.certificates
        for key, path in certificates.items():
            with contextlib.suppress(OSError, ValueError):  # the output itself says what is wrong with it
                texts = read_file(path).decode("ascii").split(_PEM_END)[:-1]
                pems = [text[max(0, text.find(_PEM_BEGIN)) :] + _PEM_END for text in texts]
                ends_s[name, key] = min(_end_s(ssl.PEM_cert_to_DER_cert(pem)) for pem in pems)
        if isinstance(settings, TakesSettings):
            with contextlib.suppress(OSError):
                free_bytes = shutil.disk_usage(settings.effective_directory).free
    return ends_s, free_bytes


def _end_s(certificate: bytes) -> float:
    """Return when a certificate ends (RFC 5280, 4.1). Python's ssl has this for peers only."""
    fields = _elements(_elements(_elements(certificate, 1)[0][1], 1)[0][1], 5)
    fields = fields[fields[0][0] == _VERSION :]  # the version may be absent
    validity = fields[3]  # after serial number, algorithm and issuer
    if validity[0] != _SEQUENCE:
        raise ValueError("no validity")
    tag, text = _elements(validity[1], 2)[1]
    digits = text.decode("ascii")
    if tag == _UTC_TIME:  # with a year of two digits
        digits = ("20" if digits < "5" else "19") + digits
    return datetime.strptime(digits, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC).timestamp()


def _elements(data: bytes, most: int) -> list[tuple[int, bytes]]:
    """Return the tag and the content of the first ``most`` elements in DER. Raises ValueError."""
    found: list[tuple[int, bytes]] = []
    while data and len(found) < most:
        if len(data) < 2:
            raise ValueError("cut off")
        tag, size, start = data[0], data[1], 2
        if size & 0x80:
            start += size & 0x7F
            size = int.from_bytes(data[2:start])
        if len(data) < start + size:
            raise ValueError("cut off")
        found.append((tag, data[start : start + size]))
        data = data[start + size :]
    if len(found) < most:
        raise ValueError("too few elements")
    return found
