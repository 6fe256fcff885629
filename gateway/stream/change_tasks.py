"""Changes to a running stream: a lower rate while frames are late, a pause while there are no subscribers."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import LinkError, RequestError
from gateway.rtc3d.components import ComponentType
from gateway.stream.defects import defect_error
from gateway.stream.running_clock import running_clock
from gateway.stream.session import Session
from gateway.stream.status import StreamStatus
from gateway.stream.stream_control import StreamControl

DEMAND_POLL_S: Final = 0.05
"""How often an on-demand stream checks for subscribers. It polls because a notification could be missed."""

FIRST_RETRY_S: Final = 1.0
"""How long to wait before a refused stop or resume is repeated. Each wait is twice as long as the last."""

MAX_RESUMES: Final = 4
"""How often a resume may be refused, in a row, before the connection ends."""

_MAX_RETRY_S: Final = 30.0

logger = logging.getLogger(__name__)


class ChangeTasks:
    """Decides what the server of one session should send, and asks for it, until ``cancel``.

    Three facts decide: whether frames are wanted, how often their rate is to be halved, and which components
    are wanted. One task brings the server to what they say now, so changes never overlap. ``has_subscribers``
    returns whether the stream's components may have subscribers.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        session: Session,
        control: StreamControl,
        has_subscribers: Callable[[], bool],
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._session = session
        self._control = control
        self._has_subscribers = has_subscribers
        self._is_wanted = True
        self._halvings = 0  # as wanted
        self._requested_halvings = 0  # in the newest request for another rate
        self._components: Sequence[ComponentType] | None = None  # to request instead of the former ones
        self._changed = asyncio.Event()  # _is_wanted, _halvings or _components
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Start to change the stream as needed. Call it after the handshake."""
        self._start_task(self._apply_changes)
        if self._stream.on_demand:
            self._start_task(self._follow_demand)

    def lateness_changed(self, halvings: int) -> None:
        """React to late frames: with ``adapt_rate``, start to request the rate halved ``halvings`` times.

        Without it, only log that frames are late, or in time again if ``halvings`` is 0. Returns at once.
        """
        if self._stream.adapt_rate:
            self._halvings = halvings
            self._changed.set()
        elif halvings:
            self._status.frames_late(self._status.lag_s, running_clock().longest_delay_s())
        else:
            self._status.frames_in_time()

    def request_components(self, components: Sequence[ComponentType]) -> None:
        """Start to request these components instead of the former ones; return at once."""
        self._components = components
        self._changed.set()

    @property
    def is_full_rate(self) -> bool:
        """Whether the server was asked for the configured rate, and for nothing less since then."""
        return not (self._control.is_stopped or self._halvings or self._requested_halvings)

    def cancel(self) -> None:
        """Cancel all tasks."""
        for task in self._tasks:
            task.cancel()

    def _start_task(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self._tasks.append(asyncio.create_task(self._run_until_error(work)))

    async def _run_until_error(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a task; end the session if it fails, because then nothing changes the stream any more."""
        try:
            await (
                work()
            )  # called here: a task that is cancelled before it starts must leave no coroutine behind
        except LinkError as error:
            logger.debug("%s: %s", self._status.name, error)  # the supervisor reports it
            self._session.fail(error)
        except Exception as defect:  # noqa: BLE001 - the supervisor logs it and connects again
            self._session.fail(defect_error(defect))

    async def _apply_changes(self) -> None:
        refusals = 0
        while True:
            await self._changed.wait()
            self._changed.clear()
            if await self._apply():
                refusals = 0
                continue
            refusals += 1
            if self._is_wanted and refusals >= MAX_RESUMES:
                raise RequestError(
                    f"{self._session.server} refuses to send frames again after they were stopped; "
                    "connecting again"
                )
            try:
                async with asyncio.timeout(min(FIRST_RETRY_S * 2 ** (refusals - 1), _MAX_RETRY_S)):
                    await self._changed.wait()  # what is wanted may change while waiting
            except TimeoutError:
                self._changed.set()

    async def _apply(self) -> bool:
        """Request what is wanted now; return False if that must be repeated."""
        control = self._control
        if not self._is_wanted:
            return control.is_stopped or await self._stop()
        if control.is_stopped:
            self._status.events.log(
                logging.INFO, "a subscriber appeared; frames are requested again", "demand"
            )
            return await self._request_rate()
        if self._components is not None:
            components, self._components = self._components, None
            self._requested_halvings = 0
            await control.request_components(components)
        if self._halvings != self._requested_halvings:
            await self._change_rate()
        return True

    async def _stop(self) -> bool:
        is_stopped = await self._control.stop()
        if is_stopped:
            self._status.events.log(logging.INFO, "no subscribers; the stream is stopped", "demand")
        return is_stopped

    async def _request_rate(self) -> bool:
        self._requested_halvings = self._halvings
        return await self._control.request(self._halvings)

    async def _change_rate(self) -> None:
        """Request another rate. If the server refuses, it keeps the rate, and another one may be accepted."""
        lag_s = self._status.lag_s
        await self._request_rate()
        request = f"asked the server for {self._status.rate or 'its default rate'}"
        if 1000 * lag_s > self._source.max_lag_ms:
            self._status.frames_late(lag_s, running_clock().longest_delay_s(), request)
        elif self._halvings:
            logger.debug("%s: frames arrive in time; %s", self._status.name, request)
        else:
            self._status.frames_in_time(f"; {request}")

    async def _follow_demand(self) -> None:
        """Want no frames while there are no subscribers, and frames within DEMAND_POLL_S of the first one."""
        loop = asyncio.get_running_loop()
        last_subscribed_s = loop.time()
        while True:
            if self._has_subscribers():
                last_subscribed_s = loop.time()
            is_wanted = loop.time() - last_subscribed_s < self._stream.idle_after_s
            if is_wanted is not self._is_wanted:
                self._is_wanted = is_wanted
                self._changed.set()
            await asyncio.sleep(DEMAND_POLL_S)
