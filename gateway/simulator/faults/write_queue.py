"""A queue of writes to one client that are not due yet."""

import asyncio
import logging
import math
import time
from collections import deque
from typing import Final

from gateway.rtc3d_server.connection_filter import FilteredConnection
from gateway.rtc3d_server.timers import call_after_us
from gateway.simulator.faults.outgoing import PendingWrite

MAX_WAITING_BYTES: Final = 4 * 1024 * 1024
"""How many bytes may wait to be sent on one connection; beyond this, packets are dropped."""

_log = logging.getLogger(__name__)


class WriteQueue:
    """Writes to a connection in order, each write when it is due."""

    def __init__(self, connection: FilteredConnection) -> None:
        self._connection = connection
        self._waiting: deque[PendingWrite] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._was_full = False
        self.waiting_bytes = 0
        """The total size of the waiting writes."""

    def put(self, writes: list[PendingWrite]) -> None:
        """Write what is due and keep the rest. If that exceeds MAX_WAITING_BYTES, drop ``writes``."""
        size = sum(len(write.data) for write in writes)
        if self._waiting and self.waiting_bytes + size > MAX_WAITING_BYTES:
            if not self._was_full:
                _log.warning(
                    "%s: faults delay more than %d MiB; dropping packets",
                    self._connection.name,
                    MAX_WAITING_BYTES >> 20,
                )
            self._was_full = True
            return
        self._waiting.extend(writes)
        self.waiting_bytes += size
        self._write_due(time.monotonic())

    def flush(self) -> None:
        """Write everything at once."""
        self._write_due(math.inf)

    def clear(self) -> None:
        """Discard everything."""
        self._cancel_timer()
        self._waiting.clear()
        self.waiting_bytes = 0

    def _write_due(self, now_s: float) -> None:
        while self._waiting and self._waiting[0].due_s <= now_s:
            data = self._waiting.popleft().data
            while self._waiting and self._waiting[0].joins_previous and self._waiting[0].due_s <= now_s:
                data += self._waiting.popleft().data
            self.waiting_bytes -= len(data)
            self._connection.write(data)
        self._cancel_timer()
        if self._waiting:
            self._timer = call_after_us(
                1_000_000 * (self._waiting[0].due_s - now_s), lambda: self._write_due(time.monotonic())
            )

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
