"""Starts the process for LSL, sends to it, and starts it again if it ends."""

import contextlib
import logging
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Final

from gateway.outputs.adapters.lsl.process import LslReport, Message
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.runtime.failures import FailureLog
from gateway.runtime.workers import module_environment, thread_starts

SILENCE_S: Final = 10.0
"""If the process reports nothing for so long, or takes nothing, it is killed and another one started."""

_FIRST_RETRY_S: Final = 1.0
_MAX_RETRY_S: Final = 30.0
_STEADY_S: Final = 60.0
"""After a process that lived so long, the next one starts after _FIRST_RETRY_S."""

_END_S: Final = 1.0
_SOCKET_BYTES: Final = 1 << 20
_READ_BYTES: Final = 1 << 16
_NO_STREAMS: Final[frozenset[int]] = frozenset()

logger = logging.getLogger(__name__)


class LslProcesses:
    """Has one process for LSL at a time. ``send``, ``restart`` and ``stop`` are for one thread.

    ``on_wanted_changed`` is called in any thread.
    """

    def __init__(self, settings: LslSettings, on_wanted_changed: Callable[[], None] = lambda: None) -> None:
        self.wanted = _NO_STREAMS
        """The numbers of the streams that somebody receives, or received from a process that has ended while
        no other one is ready.
        """
        self._on_wanted_changed = on_wanted_changed
        self._settings = settings
        self._report = LslReport()
        self._problem = "the process for LSL has not started yet"
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._started_s = 0.0
        self._retry_s = 0.0
        self._retry_delay_s = _FIRST_RETRY_S
        self._is_stopped = False
        self._failures = FailureLog(logger, "lsl")

    @property
    def is_ready(self) -> bool:
        """Whether there is a process that has loaded liblsl."""
        return self._socket is not None and bool(self._report.ready)

    @property
    def problem(self) -> str:
        """Why nothing can be sent now, and what to do; "" if it can."""
        if self._socket is None:
            return self._problem
        if self._report.not_opened:
            return _not_opened(self._report)
        return "" if self._report.ready else "liblsl is not loaded yet"

    @property
    def version(self) -> str:
        """The version of liblsl, as its number; "" if it is not loaded."""
        return self._report.ready

    @property
    def is_due(self) -> bool:
        """Whether ``restart`` should be called, because there is no process."""
        return self._socket is None and not self._is_stopped and time.monotonic() >= self._retry_s

    def restart(self) -> bool:
        """Start a process if there is none; return whether there is a new one, which has no streams yet."""
        if not self.is_due:
            return False
        self._report = LslReport()
        self._started_s = time.monotonic()
        self._retry_s = self._started_s + self._retry_delay_s
        try:
            ours, self._process = _start_process(self._settings)
        except OSError as error:
            self._failed(f"the process for LSL cannot be started: {error.strerror}")
            return False
        ours.settimeout(SILENCE_S)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BYTES)
        self._socket = ours
        reader = threading.Thread(
            target=self._read_reports, args=(ours, self._process), name="lsl-reports", daemon=True
        )
        thread_starts.start(reader)
        return True

    def send(self, message: Message) -> bool:
        """Send one message; return False if there is no process. The next process gets all streams."""
        ours = self._socket
        if ours is None:
            return False
        try:
            ours.sendall(message.encode())
        except OSError:
            # A part of the message may have been sent, so the connection is of no use any more.
            if self._process is not None:
                self._process.kill()
            return False
        return True

    def stop(self) -> None:
        """End the process."""
        self._is_stopped = True
        self._problem = "LSL is closed; start the gateway again"
        ours, self._socket = self._socket, None
        self._set_wanted(_NO_STREAMS)
        if ours is not None:
            with contextlib.suppress(OSError):
                ours.shutdown(socket.SHUT_RDWR)
        if self._process is not None:
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if ours is not None:
            ours.close()

    def _read_reports(self, ours: socket.socket, process: subprocess.Popen[bytes]) -> None:
        """Read what the process reports until it ends, in a thread of its own."""
        unread = b""
        hung = False
        try:
            while data := ours.recv(_READ_BYTES):
                *lines, unread = (unread + data).split(b"\n")
                for line in lines:
                    self._take(LslReport.decode(line))
        except TimeoutError:
            hung = True
        except (OSError, ValueError):  # ``stop`` has closed it, or it is no report
            pass
        process.kill()  # if it hangs, or if its last report cannot be read, it still runs
        status = process.wait()
        if self._is_stopped:
            return
        lived_s = time.monotonic() - self._started_s
        if lived_s >= _STEADY_S:
            self._retry_delay_s = _FIRST_RETRY_S
        self._retry_s = time.monotonic() + self._retry_delay_s
        self._retry_delay_s = min(2 * self._retry_delay_s, _MAX_RETRY_S)
        if hung:
            self._failed(f"the process for LSL has not answered for {SILENCE_S:g} s")
        elif self._report.failure:
            self._failed(f"the process for LSL failed: {self._report.failure}")
        else:
            self._failed(f"the process for LSL ended {_reason(status)}")
        self._socket = None  # after problem and delay are known: from now on, others look at them
        ours.close()

    def _take(self, report: LslReport) -> None:
        before, self._report = self._report, report
        if report.ready:
            self._set_wanted(frozenset(report.wanted))
        if report.not_opened and report.not_opened != before.not_opened:
            self._failures.failed(_not_opened(report))
        elif report.ready and not report.not_opened and (before.not_opened or not before.ready):
            self._failures.succeeded(f"streams are offered by liblsl {report.ready}")

    def _set_wanted(self, numbers: frozenset[int]) -> None:
        before, self.wanted = self.wanted, numbers
        if numbers != before:
            self._on_wanted_changed()

    def _failed(self, text: str) -> None:
        self._problem = f"{text}; it is started again"
        self._failures.failed(self._problem)


def _start_process(settings: LslSettings) -> tuple[socket.socket, subprocess.Popen[bytes]]:
    """Return the socket to a new process, and the process. Raises OSError."""
    ours, theirs = socket.socketpair()
    try:
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "gateway.outputs.adapters.lsl.process"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # liblsl writes a line for each mistake of a client
                env=lsl_environment(settings),
                start_new_session=True,  # Ctrl+C is for the gateway
            )
    except OSError:
        ours.close()
        raise
    return ours, process


def lsl_environment(settings: LslSettings) -> dict[str, str]:
    """Return the environment of a process that uses liblsl as the settings say."""
    config = {"LSLAPICFG": settings.config} if settings.config else {}
    return {**module_environment(), "OPENBLAS_NUM_THREADS": "1", **config}


def _not_opened(report: LslReport) -> str:
    return f"liblsl cannot open the stream {report.not_opened}"


def _reason(status: int) -> str:
    if status >= 0:
        return f"with status {status}"
    with contextlib.suppress(ValueError):
        return f"by {signal.Signals(-status).name}"
    return f"by signal {-status}"
