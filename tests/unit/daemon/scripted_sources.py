"""Whole sources in virtual time: their servers are scripted, and no thread runs."""

import asyncio
import functools
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest

from gateway.config.settings import SourceSettings
from gateway.runtime.workers import WorkerThread
from gateway.session.supervisor import Supervisor
from tests.support.clocks import read_clocks
from tests.unit.session.scripted_server import ScriptedServer


class Servers:
    """A scripted server for each host name; ``connect`` is how supervisors reach them."""

    def __init__(self, threads: "SlowThreads") -> None:
        self._servers: dict[str, ScriptedServer] = {}
        self.threads = threads

    def __getitem__(self, host: str) -> ScriptedServer:
        return self._servers.setdefault(host, ScriptedServer())

    async def connect(self, source: SourceSettings, session: Any) -> asyncio.Transport:
        return await self[source.host].connect(source, session)


def use_scripted_servers(monkeypatch: pytest.MonkeyPatch) -> Servers:
    """Connect the supervisors of all sources to scripted servers from now on, in the loop's time."""
    servers = Servers(SlowThreads(monkeypatch))
    supervisor = functools.partial(Supervisor, connect=servers.connect, read_clocks=read_clocks)
    monkeypatch.setattr("gateway.daemon.source.Supervisor", supervisor)
    return servers


class SlowThreads:
    """Stands for the thread of every WorkerThread: makes calls at once, or while ``is_slow`` on request."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.is_slow = False
        self._waiting: list[tuple[Future[Any], Callable[[], Any]]] = []
        monkeypatch.setattr(WorkerThread, "submit", lambda _thread, call: self._submit(call))

    def _submit(self, call: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.append((future, call))
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
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(call())
                except Exception as error:  # noqa: BLE001 - the task that waits for the future gets it
                    future.set_exception(error)
