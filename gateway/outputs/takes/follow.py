"""Takes that follow what the server does: its recordings, its measurements, or events that it sends."""

import asyncio
import logging
import struct
from collections.abc import Callable, Coroutine
from typing import Any, Final

from gateway.errors import QueryError
from gateway.messages.encode import COUNT_OFFSET, ITEMS_OFFSET
from gateway.outputs.contract import Publisher
from gateway.outputs.takes.folder import StoredTake
from gateway.outputs.takes.source_takes import SourceTakes
from gateway.outputs.takes.take_file import TakeFile
from gateway.runtime.failures import HOLD_S, FailureLog

END_S: Final = 2.0
"""For how long the server must send No Data until a take of a measurement ends."""

LOST_S: Final = 60.0
"""A measurement counts as ended after the connection has been lost for this long."""

_NUM_EVENTS: Final = struct.Struct(">i")
_EVENT_ID: Final = struct.Struct(">I20x")  # an event has 24 bytes, its id first

logger = logging.getLogger(__name__)


class TakeFollower:
    """Starts and stops takes of one source as the setting ``follow`` says.

    It stops only a take that it started. If another take is running, that one goes on, and none is started.
    """

    def __init__(self, takes: SourceTakes, monotonic: Callable[[], float]) -> None:
        self._takes = takes
        self._monotonic = monotonic
        self._take: TakeFile | None = None  # that was started here
        self._is_measuring: bool | None = None
        self._since_s = monotonic()
        self._is_handled = False  # the present measurement has, or had, a take
        self._tasks: set[asyncio.Task[None]] = set()
        self._failures = FailureLog(logger, takes.source, HOLD_S)

    @property
    def needs_events(self) -> bool:
        """Whether events start and stop takes."""
        return self._takes.storage.settings.follow == "events"

    async def follow_recording(self, *, start: bool, name: str) -> dict[str, Any]:
        """Start or stop a take with a recording on the server; return what to add to the peer's reply."""
        if self._takes.storage.settings.follow != "recording":
            return {}
        try:
            if start:
                return {"take": (await self._begin(name)).name}
            if self.is_running:
                return {"take": (await self._takes.announced().stop()).name}
        except QueryError as error:
            logger.warning("%s: no take follows the recording: %s", self._takes.source, error)
            return {"take_problem": str(error)}
        return {}

    def show_measurement(self, is_running: bool | None) -> None:
        """Start a take if a measurement begins, before its first frame is published."""
        self._is_measuring = is_running
        self._since_s = self._monotonic()
        self.maintain()

    def maintain(self) -> None:
        """Start the take of the measurement, or stop it if the measurement has ended. Called once a second.

        A measurement ends when the server says so, which is No Data, for END_S. A stall or a lost connection
        does not end it, or it would be split into several takes; but what does not come back for LOST_S has
        ended.
        """
        if self._takes.storage.settings.follow != "measurement":
            return
        if self._is_measuring:
            if not self._is_handled:
                self._begin_soon()
        elif self._monotonic() - self._since_s >= (LOST_S if self._is_measuring is None else END_S):
            self._is_handled = False
            self._end_soon()

    def receive_event(self, event_id: int) -> None:
        """Start or stop a take at an event of the server. The same event can do both."""
        settings = self._takes.storage.settings
        if self.is_running:
            if event_id == settings.stop_event_id:
                self._end_soon()
        elif event_id == settings.start_event_id:
            self._begin_soon()

    @property
    def is_running(self) -> bool:
        """Whether the take that was started here is still running."""
        return self._take is not None and self._takes.take is self._take

    def _begin(self, name: str = "") -> Coroutine[Any, Any, StoredTake]:
        """Start a take at once; the coroutine waits for the disk. Raises QueryError."""
        take = self._takes.announced().start(name, has_free_name=True)
        self._take = self._takes.take
        return take

    def _begin_soon(self) -> None:
        if self.is_running:
            return
        running = self._takes.take
        if running is not None:
            self._is_handled = True
            logger.info(
                "%s: take %r is running already, so no other one is started", self._takes.source, running.name
            )
            return
        try:
            take = self._begin()
        except QueryError as error:
            self._failures.failed(f"no take is started: {error}")
            return
        self._is_handled = True
        self._run(take)

    def _end_soon(self) -> None:
        if self.is_running:
            try:
                self._run(self._takes.announced().stop())
            except QueryError as error:
                self._failures.failed(f"the take is not stopped: {error}")

    def _run(self, call: Coroutine[Any, Any, StoredTake]) -> None:
        async def log_failure() -> None:
            try:
                await call
            except QueryError as error:
                self._is_handled = False
                self._failures.failed(f"a take is not started or stopped: {error}")
            else:
                self._failures.recovered("takes are started and stopped again")

        task = asyncio.get_running_loop().create_task(log_failure())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


class EventPublisher:
    """Shows events to the follower. Those that start and stop a take are in the take."""

    def __init__(self, publisher: Publisher, follower: TakeFollower) -> None:
        self._publisher = publisher
        self._follower = follower

    @property
    def wanted(self) -> bool:
        """Whether events are recorded, or start and stop takes."""
        return self._publisher.wanted or self._follower.needs_events

    def publish(self, message: bytes) -> None:
        """See Publisher."""
        is_published = False
        for event_id in event_ids(message) if self._follower.needs_events else ():
            if self._follower.is_running and not is_published:
                is_published = True
                self._publisher.publish(message)  # before one of these events stops the take
            self._follower.receive_event(event_id)
        if not is_published:
            self._publisher.publish(message)

    def close(self) -> None:
        """See Publisher."""
        self._publisher.close()


def event_ids(message: bytes) -> list[int]:
    """Return the ids of the events in an ``events_t``, each as an unsigned number."""
    (number,) = _NUM_EVENTS.unpack_from(message, COUNT_OFFSET)
    end = ITEMS_OFFSET + number * _EVENT_ID.size
    return [event_id for (event_id,) in _EVENT_ID.iter_unpack(message[ITEMS_OFFSET:end])]
