"""Commands that peers' queries send to the server of one source: one at a time, and shared where equal."""

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

from gateway.config.settings import SourceSettings
from gateway.errors import GatewayError, LinkError, QueryError, ReplyTimeoutError, ServerError
from gateway.log import DefectLog
from gateway.rtc3d.commands import Command
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet
from gateway.stream.parameters import Connection
from gateway.stream.running_time import running_timeout
from gateway.stream.status import StreamStatus

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class StreamAccess(NamedTuple):
    """What queries need of one stream now. ``connection`` is None while there is none that takes commands."""

    components: Sequence[ComponentType]
    status: StreamStatus
    connection: Connection | None


class ServerRequests:
    """Sends commands to the server of one source over the connections of its streams."""

    def __init__(self, settings: SourceSettings, streams: Callable[[], Sequence[StreamAccess]]) -> None:
        self._settings = settings
        self._streams = streams
        self._pending: dict[Hashable, asyncio.Task[Any]] = {}
        self._lock = asyncio.Lock()
        self._defects = DefectLog(logger, settings.name)

    @property
    def session(self) -> int:
        """A number that grows with every connection of any stream."""
        return max(stream.status.session for stream in self._streams())

    @property
    def parameters_version(self) -> int:
        """The version of the server's parameters; 0 before the first."""
        return self._streams()[0].status.parameters_version

    @property
    def is_connected(self) -> bool:
        """Whether any stream has a connection."""
        return bool(self.connections)

    def no_connection_error(self) -> QueryError:
        """Return the error that says why there is no connection, since when, and what to do about it."""
        newest = max((stream.status for stream in self._streams()), key=lambda status: status.last_error_s)
        text = f"source {self._settings.name!r} has no connection"
        if newest.last_error:
            problem, separator, remedy = newest.last_error.partition("; ")
            age_s = time.monotonic() - newest.last_error_s
            text += f": {problem.removeprefix('connection ')}, tried {age_s:.1f} s ago{separator}{remedy}"
        else:
            text += f" yet: connecting to {self._settings.host}:{self._settings.port}"
        return QueryError(text, code="no-connection")

    async def send(
        self, command: Command, *, fallback: Command | None = None, connection: Connection | None = None
    ) -> tuple[Command, Packet]:
        """Send a command, and ``fallback`` if the server refuses or ignores it; return the one answered.

        The second value is the server's reply. Without ``connection`` any one is used. Raises QueryError, at
        the latest after query_timeout_s, which includes the wait for earlier requests.
        """
        name, timeout_s = f"source {self._settings.name!r}", self._settings.query_timeout_s
        try:
            async with running_timeout(timeout_s), self._lock:
                try:
                    return command, await self._send(command, connection)
                except QueryError:
                    if fallback is None:
                        raise
                return fallback, await self._send(fallback, connection)
        except LinkError as error:
            raise QueryError(f"{name} has just lost its connection: {error}", code="no-connection") from error
        except TimeoutError:
            waiting = f"queries waiting for the server: {len(self._pending)}"
            text = f"{name}: no answer within {timeout_s:g} s; {waiting}"
            raise QueryError(text, code="timeout") from None

    @property
    def connections(self) -> list[Connection]:
        """The connections that take commands."""
        return [stream.connection for stream in self._streams() if stream.connection is not None]

    async def _send(self, command: Command, connection: Connection | None) -> Packet:
        if connection is None:
            connection = next(iter(self.connections), None)
        if connection is None:
            raise self.no_connection_error()
        name = f"source {self._settings.name!r}"
        try:
            return await connection.ask(command)
        except ServerError as error:
            raise self.refused(command, error) from error
        except ReplyTimeoutError as error:
            raise QueryError(f"{name}: {error}", code="timeout") from error

    def refused(self, command: Command, error: ServerError) -> QueryError:
        """Return the error that says that the server refuses ``command``."""
        text = f"source {self._settings.name!r}: the server does not know {command}, or refuses it: {error}"
        return QueryError(text, code="refused")

    async def share(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> _Result:
        """Return the result of ``work``; callers with an equal ``key`` at the same time share one run."""
        return await asyncio.shield(self.start(key, work))

    def start(self, key: Hashable, work: Callable[[], Coroutine[Any, Any, _Result]]) -> asyncio.Task[_Result]:
        """Start ``work`` unless it runs for an equal ``key`` already; return its task."""
        task = self._pending.get(key)
        if task is None:
            task = asyncio.create_task(work())
            task.add_done_callback(lambda done: self._finish(key, done))
            self._pending[key] = task
        return task

    def _finish(self, key: Hashable, task: asyncio.Task[Any]) -> None:
        del self._pending[key]
        if task.cancelled():
            return
        error = task.exception()  # retrieve it, even if no caller waits any more
        if error is not None and not isinstance(error, GatewayError):
            self._defects.log(error)
