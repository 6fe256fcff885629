"""The end of programs that use this package, and their forks: what they have opened is closed, or refused.

Python waits for all threads that are not daemons before it runs atexit and weakref.finalize. Zenoh calls back
in such threads, which end when their session is closed; so a program that does not close it would never end.

A daemon thread that returns from Zenoh during Python's shutdown aborts the process: one that closes a
session, and one in which Zenoh calls back, which is a daemon if a daemon has started it.
"""

import atexit
import contextlib
import os
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable
from concurrent.futures import thread as _thread_pools  # noqa: F401 - what it registers must run after ours
from typing import Any, Final, Protocol, TypeVar

from gateway.errors import ForkError

_ZENOH_THREAD: Final = "(pyo3-closure)"
"""How the names of the threads end in which Zenoh calls back."""

_OWN_THREADS: Final = frozenset({"live-sources", "refill"})
"""Threads of this package that may be in a call of Zenoh. They end when the session is closed."""

_JOIN_S: Final = 20.0
"""How long to wait for these threads on a busy computer: one that is still in Zenoh aborts the process."""

_JOIN_FOREIGN_S: Final = 1.0
"""How long to wait for daemons in which Zenoh calls back: the session of some may not be closed here."""


class _Closable(Protocol):
    def close(self) -> Any: ...


_ClosableT = TypeVar("_ClosableT", bound=_Closable)


class _OpenObjects:
    """What the program has opened, in this order, and the thread that closes it at the end."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._opened: list[weakref.ref[Any]] = []
        self._closer: threading.Thread | None = None
        atexit.register(self.close)  # if Ctrl-C has ended the waiting for threads
        os.register_at_fork(after_in_child=self._forget)

    def add(self, opened: _Closable) -> None:
        with self._lock:
            self._opened = [ref for ref in self._opened if ref() is not None]
            self._opened.append(weakref.ref(opened))
            if self._closer is None:
                self._closer = threading.Thread(target=self._close_at_end, name="close-at-end", daemon=False)
                self._closer.start()
                # Pools wait for their threads before the main thread counts as ended.
                register = getattr(threading, "_register_atexit", None)
                if register is not None:
                    with contextlib.suppress(RuntimeError):  # the program is already ending
                        register(self._close_after_exception)

    def close(self) -> None:
        """Close everything, the newest first."""
        while True:
            with self._lock:
                if not self._opened:
                    return
                opened = self._opened.pop()()
            if opened is not None:
                try:
                    opened.close()
                except Exception:  # noqa: BLE001 - the others must be closed nevertheless
                    traceback.print_exc()

    def _close_after_exception(self) -> None:
        if _has_raised():
            self.close()

    def _close_at_end(self) -> None:
        threading.main_thread().join()
        if not _has_raised():
            self._join_others()
        self.close()
        _join(lambda thread: thread.name in _OWN_THREADS, _JOIN_S)
        _join(lambda thread: thread.daemon and thread.name.endswith(_ZENOH_THREAD), _JOIN_FOREIGN_S)

    def _join_others(self) -> None:
        """Wait for the threads that Python waits for: the program has not ended before."""
        mine = {threading.main_thread(), threading.current_thread()}
        while others := [
            thread
            for thread in threading.enumerate()
            if thread.is_alive()  # not if Ctrl-C has interrupted its join: Python takes it as stopped
            and not (thread.daemon or thread in mine)
            and not (thread.name in _OWN_THREADS or thread.name.endswith(_ZENOH_THREAD))
        ]:
            for thread in others:
                thread.join()

    def _forget(self) -> None:
        """Leave what is open to the parent: closing it here would close the connections of both."""
        self._lock = threading.Lock()
        self._opened = []
        self._closer = None


def _join(is_wanted: Callable[[threading.Thread], bool], limit_s: float) -> None:
    """Wait for the wanted threads, no longer than this in all."""
    end_s = time.monotonic() + limit_s
    for thread in filter(is_wanted, threading.enumerate()):
        thread.join(max(0.0, end_s - time.monotonic()))


def _has_raised() -> bool:
    """Whether an exception, such as that of Ctrl-C, has ended the main thread."""
    return getattr(sys, "last_type", None) is not None


_open_objects: Final = _OpenObjects()


def close_at_end(opened: _ClosableT) -> _ClosableT:
    """Close an object when the program has ended, unless nothing refers to it any more; return it.

    The program has ended when its main thread has, and all other threads that are not daemons; or when an
    exception, such as that of Ctrl-C, has ended the main thread. Closing twice must be allowed.
    """
    _open_objects.add(opened)
    return opened


class Process:
    """The process that something was opened in: after a fork, the child has no threads to receive with."""

    def __init__(self) -> None:
        self._pid = os.getpid()

    @property
    def is_forked(self) -> bool:
        """Whether this is a fork of that process."""
        return os.getpid() != self._pid

    def check(self, what: str) -> None:
        """Raise ForkError, which says that ``what`` was opened before the fork, if this is a fork."""
        if self.is_forked:
            raise ForkError(
                f"{what} was opened in process {self._pid}, and does not work in process {os.getpid()}, "
                "which is a fork of it; start processes with multiprocessing's method 'spawn' "
                "(in joblib: backend 'loky'; in a DataLoader: multiprocessing_context='spawn'), "
                "or open it only after the fork"
            )
