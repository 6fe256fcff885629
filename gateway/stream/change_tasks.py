"""Changes to a running stream: a lower rate while frames are late, a pause while there are no subscribers."""

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError
from gateway.log import FailureLog
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl

DEMAND_POLL_S: Final = 0.05
"""How often an on-demand stream checks for subscribers. It polls because a notification could be missed."""

logger = logging.getLogger(__name__)


class ChangeTasks:
    """The tasks that change the stream of one session, until ``cancel``.

    ``has_subscribers`` returns whether the stream's components may have subscribers.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        control: StreamControl,
        has_subscribers: Callable[[], bool],
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._control = control
        self._has_subscribers = has_subscribers
        self._lateness = FailureLog(logger, status.name)
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self) -> None:
        """Start to follow the demand if the stream is on demand. Call it after the handshake."""
        if self._stream.on_demand:
            self._start_task(self._follow_demand())

    def lateness_changed(self, halvings: int) -> None:
        """React to late frames: with ``adapt_rate``, start to request the rate halved ``halvings`` times.

        Without it, only log that frames are late, or in time again if ``halvings`` is 0. Returns at once.
        """
        if self._stream.adapt_rate:
            self._start_task(self._change_rate(halvings))
        elif halvings:
            self._lateness.failed(f"frames arrive {1000 * self._status.lag_s:.0f} ms late")
        else:
            self._lateness.recovered("frames arrive in time")

    def cancel(self) -> None:
        """Cancel all tasks."""
        for task in self._tasks:
            task.cancel()

    def _start_task(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(self._run_until_link_error(work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run_until_link_error(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except LinkError as error:
            logger.debug("%s: %s", self._status.name, error)  # the session ends and reports the reason

    async def _change_rate(self, halvings: int) -> None:
        lag_ms = 1000 * self._status.lag_s
        await self._control.change_rate(halvings)
        request = f"asked the server for {self._status.rate or 'its default rate'}"
        if lag_ms > self._source.max_lag_ms:
            self._lateness.failed(f"frames arrive {lag_ms:.0f} ms late; {request}")
        elif halvings:
            logger.debug("%s: frames arrive in time; %s", self._status.name, request)
        else:
            self._lateness.recovered(f"frames arrive in time; {request}")

    async def _follow_demand(self) -> None:
        """Stop the stream while it has no subscribers, and resume it within DEMAND_POLL_S of the first."""
        loop = asyncio.get_running_loop()
        last_subscribed_s = loop.time()
        running = True
        while True:
            if self._has_subscribers():
                last_subscribed_s = loop.time()
                if not running:
                    logger.info("%s: a subscriber appeared; streaming", self._status.name)
                    await self._control.resume()
                    running = True
            elif running and loop.time() - last_subscribed_s >= self._stream.idle_after_s:
                logger.info("%s: no subscribers; the stream is stopped", self._status.name)
                await self._control.pause()
                running = False
            await asyncio.sleep(DEMAND_POLL_S)
