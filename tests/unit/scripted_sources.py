"""Whole sources in virtual time: their servers are scripted, and no thread runs."""

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.stream.supervisor import Supervisor
from gateway.worker_thread import WorkerThread
from tests.unit.stream.scripted_server import ScriptedServer
from tests.unit.stream.virtual_time import read_clocks


class Servers:
    """A scripted server for each host name; ``connect`` is how supervisors reach them."""

    def __init__(self) -> None:
        self._servers: dict[str, ScriptedServer] = {}

    def __getitem__(self, host: str) -> ScriptedServer:
        return self._servers.setdefault(host, ScriptedServer())

    async def connect(self, source: SourceSettings, session: Any) -> asyncio.Transport:
        return await self[source.host].connect(source, session)


def use_scripted_servers(monkeypatch: pytest.MonkeyPatch) -> Servers:
    """Connect the supervisors of all sources to scripted servers from now on, in the loop's time."""
    make_calls_of_worker_threads_at_once(monkeypatch)
    servers = Servers()
    supervisor = functools.partial(Supervisor, connect=servers.connect, read_clocks=read_clocks)
    monkeypatch.setattr("gateway.source.Supervisor", supervisor)
    return servers


def make_calls_of_worker_threads_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the calls of every WorkerThread at once, without a thread."""

    def submit(_thread: WorkerThread, call: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        _make(future, call)
        return future

    monkeypatch.setattr(WorkerThread, "submit", submit)


def _make(future: Future[Any], call: Callable[[], Any]) -> None:
    if future.set_running_or_notify_cancel():
        try:
            future.set_result(call())
        except Exception as error:  # noqa: BLE001 - the task that waits for the future gets it
            future.set_exception(error)


class SlowThreads(ThreadPoolExecutor):
    """Stands for the threads of asyncio.to_thread: makes calls at once, or while ``is_slow`` on request.

    asyncio accepts only a subclass of ThreadPoolExecutor here. It starts no thread.
    """

    def __init__(self) -> None:
        super().__init__(max_workers=1)
        self.is_slow = False
        self._waiting: list[tuple[Future[Any], Callable[[], Any]]] = []
        asyncio.get_running_loop().set_default_executor(self)

    def submit(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.append((future, functools.partial(call, *args, **kwargs)))
        if not self.is_slow:
            self.finish()
        return future

    @property
    def num_waiting(self) -> int:
        """How many calls wait."""
        return len(self._waiting)

    def finish(self) -> None:
        """Make the calls that wait."""
        waiting, self._waiting = self._waiting, []
        for future, call in waiting:
            _make(future, call)
