"""What a server is asked besides frames: for peers' queries, their recordings, and its parameters again."""

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Hashable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

from gateway.config.settings import SourceSettings
from gateway.errors import CommandError, GatewayError, LinkError, QueryError, ReplyTimeoutError, ServerError
from gateway.messages.take_names import name_of_file
from gateway.queries.answers import QueryHistory
from gateway.rtc3d.commands import Command, ControlRecording, recording_duration_s, recording_options
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, decode_text
from gateway.runtime.failures import DefectLog
from gateway.session.process_clock import RunningTimeout
from gateway.session.replies import Connection
from gateway.session.status import StreamStatus

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
    ) -> Packet:
        """Send a command, and ``fallback`` if the server refuses or ignores it; return the server's reply.

        Without ``connection`` any one is used. Raises QueryError, at the latest after query_timeout_s, which
        includes the wait for earlier requests.
        """
        name, timeout_s = f"source {self._settings.name!r}", self._settings.query_timeout_s
        try:
            async with RunningTimeout(timeout_s), self._lock:
                try:
                    return await self._send(command, connection)
                except QueryError:
                    if fallback is None:
                        raise
                return await self._send(fallback, connection)
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
        task = self._pending.get(key)
        if task is None:
            task = self._pending[key] = asyncio.create_task(work())
            task.add_done_callback(partial(self._finish, key))
        return await asyncio.shield(task)

    def _finish(self, key: Hashable, task: asyncio.Task[Any]) -> None:
        del self._pending[key]
        if task.cancelled():
            return
        error = task.exception()  # retrieve it, even if no caller waits any more
        if error is not None and not isinstance(error, GatewayError):
            self._defects.log(error)


_GAP_WITHOUT_INTERVAL_S: Final = 10.0
"""The shortest time between two requested readings if ``parameters_interval_s`` is 0."""


class ParameterRefresh:
    """Reads the parameters again every ``parameters_interval_s``, and soon after ``request``.

    A server that plays a file in a loop causes a request with every pass. So requests within
    ``parameters_interval_s`` after a requested reading are served together at its end. ``last_read_s``
    returns when the server last sent its parameters, for whatever reason, on the event loop's clock.
    """

    def __init__(
        self, settings: SourceSettings, read: Callable[[], Awaitable[None]], last_read_s: Callable[[], float]
    ) -> None:
        self._defects = DefectLog(logger, settings.name)
        self._interval_s = settings.parameters_interval_s or math.inf
        self._gap_s = settings.parameters_interval_s or _GAP_WITHOUT_INTERVAL_S
        self._delay_s = settings.fresh_interval_s
        self._read = read
        self._last_read_s = last_read_s
        self._requested_s: float | None = None
        self._last_requested_reading_s = -math.inf
        self._requested = asyncio.Event()

    def request(self) -> None:
        """Read the parameters again after ``fresh_interval_s``, because they may have changed."""
        if self._requested_s is None:
            self._requested_s = asyncio.get_running_loop().time()
            self._requested.set()

    async def run(self) -> None:
        """Read the parameters again whenever it is time, until cancelled."""
        loop = asyncio.get_running_loop()
        started_s = loop.time()
        while True:
            due_s = self._due_s(started_s)
            self._requested.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(None if due_s == math.inf else due_s):
                    await self._requested.wait()
            if self._due_s(started_s) > due_s or self._requested.is_set():
                continue  # Somebody else has asked the server, or asks for an earlier time.
            started_s = loop.time()
            if self._requested_s is not None:
                self._requested_s = None
                self._last_requested_reading_s = started_s
            try:
                await self._read()
            except Exception as defect:  # noqa: BLE001 - the next reading may succeed
                self._defects.log(defect)

    def _due_s(self, started_s: float) -> float:
        """Return when the next reading is due; ``started_s`` is when the last one began."""
        due_s = max(started_s, self._last_read_s()) + self._interval_s
        if self._requested_s is None:
            return due_s
        requested_due_s = max(self._requested_s + self._delay_s, self._last_requested_reading_s + self._gap_s)
        return min(due_s, requested_due_s)


class RecordingAccess(NamedTuple):
    """What starts and stops recordings of one source (True starts).

    ``send_packet`` sends the packet of field note 16, and returns False if there is no connection.
    ``follow`` lets the outputs follow a recording: see Output.follow_recording.
    """

    send_packet: Callable[[bool], bool]
    follow: Callable[[bool, str], Awaitable[Mapping[str, Any]]]


NOT_ACCEPTED: Final = frozenset({"refused", "timeout"})
"""The codes of errors after which the server may accept something else."""

_MAX_OPTIONS_CHARS: Final = 500
"""Enough for the longest path of Windows and some options."""

_MAX_REPLY_CHARS: Final = 1000

STOPS_PER_S: Final = 4.0
"""How often a server is asked to stop at most. Each request may reach it as a packet without a reply."""

_FOLLOW_S: Final = 1.0
"""How long outputs still follow a recording whose duration is over: its last frames may be on the way."""

Done = tuple[dict[str, Any], str]
"""What the peer gets, and the text of the server's reply; "" if the server sent none."""


class Recordings:
    """Starts and stops recordings.

    Servers can be asked in two ways, neither in the specification: with a packet that cannot name the file
    (field note 16), and with commands that can (field notes 18 and 26). Without a name, the packet is sent,
    which gets no reply. With a name, the command is sent, and the packet if the server does not accept the
    command. With options, only the command is sent: without them, it would be another recording.

    A stop is never refused because of a rate, and goes on if its asker is gone. Those that come before it has
    begun share it; it begins at most STOPS_PER_S times a second.
    """

    def __init__(
        self, source: str, requests: ServerRequests, access: RecordingAccess, history: QueryHistory
    ) -> None:
        self._source = source
        self._requests = requests
        self._access = access
        self._history = history
        """Has whether the command started the recording, and what waits for the end of its duration."""
        self._lock = asyncio.Lock()
        self._next_stop_s = -math.inf  # on the event loop's clock
        self._waiting_stop: asyncio.Task[Done] | None = None
        """The newest stop if it has not begun, and no start waits behind it."""
        self._running: set[asyncio.Task[Done]] = set()  # stops, so that they are not collected as garbage

    async def start(self, name: str, options: str = "") -> Done:
        """Start a recording with a name, and with options for the server (field note 26). Raises QueryError.

        The options are sent unchanged.
        """
        sent = _start_options(name, options)
        self._waiting_stop = None
        async with self._begun():
            return await self._start(sent, needs_command=bool(options))

    async def stop(self) -> Done:
        """Stop the recording. Raises QueryError."""
        stop = self._waiting_stop
        if stop is None:
            stop = self._waiting_stop = asyncio.create_task(self._stop())
            self._running.add(stop)
            stop.add_done_callback(self._finish)
        return await asyncio.shield(stop)

    def _finish(self, stop: asyncio.Task[Done]) -> None:
        self._running.discard(stop)
        if not stop.cancelled():
            stop.exception()  # retrieve it, even if no asker waits any more

    async def _stop(self) -> Done:
        stop = asyncio.current_task()
        async with self._begun():
            loop = asyncio.get_running_loop()
            await asyncio.sleep(self._next_stop_s - loop.time())
            self._next_stop_s = loop.time() + 1 / STOPS_PER_S
            if self._waiting_stop is stop:
                self._waiting_stop = None
            reply = None
            if self._history.is_named_recording:
                reply = await self._ask(ControlRecording(start=False))
            if reply is None:
                self._send(start=False)
            self._history.is_named_recording = self._history.is_recording = False
            content = {"source": self._source, "sent": "stop", **await self._access.follow(False, "")}
            return content, reply or ""

    @contextlib.asynccontextmanager
    async def _begun(self) -> AsyncIterator[None]:
        """Have the former recording's duration forgotten, and let one command be carried out at a time."""
        async with self._lock:
            if not self._requests.is_connected:
                raise self._requests.no_connection_error()
            if self._history.end_of_recording is not None:
                self._history.end_of_recording.cancel()
                self._history.end_of_recording = None
            yield

    async def _start(self, options: str, *, needs_command: bool) -> Done:
        name = recording_options(options).get("file", "")
        following = asyncio.ensure_future(self._access.follow(True, name_of_file(name)))
        await asyncio.sleep(0)  # takes begin before the recording, which does not wait for their disk
        try:
            reply = None
            if options:
                reply = await self._ask(ControlRecording(start=True, options=options), must=needs_command)
            self._history.is_named_recording = reply is not None
            if reply is None:
                self._send(start=True)
            self._history.is_recording = True
        except QueryError:
            await following
            await self._access.follow(False, "")
            raise
        if reply is not None:
            name = recording_options(reply).get("file") or name  # the server may use another one
            with contextlib.suppress(CommandError):  # the server may know more units
                duration_s = recording_duration_s(options)
                if duration_s is not None:
                    end = self._end_following(duration_s + _FOLLOW_S)
                    self._history.end_of_recording = asyncio.create_task(end)
        named = {"name": name, "is_named": self._history.is_named_recording} if name else {}
        return {"source": self._source, "sent": "start", **named, **await following}, reply or ""

    async def _ask(self, command: ControlRecording, *, must: bool = False) -> str | None:
        """Send a command; return the text of its reply, None if the server does not accept the command.

        A reply without text counts as the usual one.

        Raises QueryError if the server ``must`` accept it.
        """
        try:
            packet = await self._requests.send(command)
        except QueryError as error:
            # A command without an answer may have been carried out. If so, a command has to stop it.
            self._history.is_named_recording = self._history.is_named_recording or error.code == "timeout"
            if must or error.code not in NOT_ACCEPTED:
                raise
            return None
        return decode_text(packet.body)[:_MAX_REPLY_CHARS] or f"OK-{command}"

    def _send(self, *, start: bool) -> None:
        if not self._access.send_packet(start):
            raise self._requests.no_connection_error()

    async def _end_following(self, after_s: float) -> None:
        """Let the outputs follow the recording no longer than its duration."""
        await asyncio.sleep(after_s)
        await self._access.follow(False, "")


def _start_options(name: str, options: str) -> str:
    """Return what follows Start in the command; "" without name and options. Raises QueryError."""
    if options and options[0] not in ", ":
        options = f",{options}"
    if name and "file" in recording_options(options):
        raise QueryError("name is the file on the server, and options have file=, too; use one of them")
    sent = f",file={name}{options}" if name else options
    if not sent.isascii():
        raise QueryError(
            "the name of a recording on the server can have ASCII letters only, as commands do (§5.1)"
        )
    if len(sent) > _MAX_OPTIONS_CHARS or not sent.isprintable():
        raise QueryError(
            f"the options of a recording can have {_MAX_OPTIONS_CHARS} characters, without line ends and "
            "other control characters"
        )
    return sent
