"""When the parameters of one source's server are read again."""

import asyncio
import contextlib
import logging
import math
from collections.abc import Awaitable, Callable
from typing import Final

from gateway.config.settings import SourceSettings
from gateway.log import DefectLog

_GAP_WITHOUT_INTERVAL_S: Final = 10.0
"""The shortest time between two requested readings if ``parameters_interval_s`` is 0."""

logger = logging.getLogger(__name__)


class ParameterRefresh:
    """Reads the parameters again every ``parameters_interval_s``, and soon after ``request``.

    A server that plays a file in a loop causes a request with every pass. So requests within
    ``parameters_interval_s`` after a requested reading are served together at its end. ``last_read_s``
    returns when the server last sent its parameters, for whatever reason, on the event loop's clock.
    """

    def __init__(
        self,
        settings: SourceSettings,
        read: Callable[[], Awaitable[None]],
        last_read_s: Callable[[], float],
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
            await self._wait_until(due_s)
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

    async def _wait_until(self, due_s: float) -> None:
        """Wait until it is time, or until a request."""
        self._requested.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout_at(None if due_s == math.inf else due_s):
                await self._requested.wait()
