"""What a session requests of its stream: handshake, rate, pause, and a lower rate while frames are late."""

import asyncio
import logging
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from enum import Enum
from typing import Any, Final

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import (
    LinkError,
    ParametersError,
    ReplyTimeoutError,
    RequestError,
    ServerError,
    SilenceError,
)
from gateway.rtc3d.commands import Command, SendParameters, SetByteOrder, StopStreaming, StreamFrames, Version
from gateway.rtc3d.components import ComponentType, described_rate_hz
from gateway.rtc3d.parameters import Parameters
from gateway.session.plan import halved, request_forms
from gateway.session.process_clock import running_clock
from gateway.session.replies import UNANSWERED, ReadParameters
from gateway.session.session import Session, defect_error
from gateway.session.status import StreamStatus


class _Outcome(Enum):
    """How the server reacts to a request for frames."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    NO_ANSWER = "no answer"  # not accepted, as far as the gateway knows (field note 20)


class StreamRequests:
    """Controls the stream of one connected session. Use once, like the session.

    It is the only sender of StreamFrames, so it knows what the server was asked for last. A command that the
    server does not answer counts as refused (field note 20). If the server refuses or does not answer a
    command, the status shows a limitation, and the gateway continues without it (field note 2). Every method
    raises LinkError if the connection ends.
    """

    def __init__(
        self,
        source: SourceSettings,
        stream: StreamSettings,
        status: StreamStatus,
        session: Session,
        read_parameters: ReadParameters,
        choose_components: Callable[[Parameters | None], Sequence[ComponentType]] | None = None,
    ) -> None:
        self._source = source
        self._only_events = stream.has_only_events
        self._stream = stream
        self._status = status
        self._session = session
        self._read_parameters = read_parameters
        self._choose_components = choose_components or (lambda _parameters: stream.components)
        self._frequency_hz: float | None = None  # of the markers, as the server announces it
        self.accepted = StreamFrames()
        """The form of StreamFrames that the server accepted, at the full rate."""
        self._requested: StreamFrames | None = None  # what the server streams now; None if it is stopped
        self._is_slow = False  # whether the server has left a command unanswered
        self._asked_again = False  # since the last request, because neither a frame nor No Data arrived

    @property
    def is_stopped(self) -> bool:
        """Whether the server accepted to stop the frames, or to send none yet."""
        return self._requested is None

    async def start(self) -> None:
        """Do the handshake (§5.3.1 to §5.3.3) and request frames (§5.3.5).

        Also raises RequestError if the server accepts no form of StreamFrames (see ``request_forms``).
        """
        await self._ask(Version())
        if self._source.byte_order == "little":
            await self._ask(SetByteOrder("little"))
        parameters = await self._fetch_parameters()
        if parameters is not None:
            self._frequency_hz = described_rate_hz(parameters, ComponentType.MARKERS)
        await self.request_components(self._choose_components(parameters))
        self._status.handshake_done(self._session.protocol_state, self._session.server, str(self.accepted))

    async def request_components(self, components: Sequence[ComponentType]) -> None:
        """Request frames with these components, at the full rate. Raises RequestError as ``start`` does."""
        await self._request_any(request_forms(self._stream.rate, components, self._frequency_hz))

    async def request(self, halvings: int) -> bool:
        """Request frames as agreed, the rate halved ``halvings`` times; return whether the server accepts."""
        request = replace(self.accepted, rate=halved(self.accepted.rate, halvings))
        return await self._request(request) is _Outcome.ACCEPTED

    async def stop(self) -> bool:
        """Stop the frames (§5.3.5) and keep the connection; return whether the server has stopped them."""
        outcome = await self._ask(StopStreaming())
        if outcome is _Outcome.REFUSED or (outcome is _Outcome.NO_ANSWER and self._session.has_data):
            return False
        self._requested = None
        self._status.rate = ""
        return True

    async def check_silence(self) -> None:
        """Check a server that sends no frames, which may be normal; raise SilenceError if it is not.

        Frames were requested, and neither a frame nor No Data has arrived: request them again. If that
        changes nothing, the connection is at fault. Otherwise no measurement is running: any reply to a
        harmless command, even a refusal, shows that the server is alive.
        """
        if self._requested is not None and not self._session.has_data and not self._only_events:
            await self._ask_again(self._requested)
            return
        answered, kinds = (
            self._session.replies.answered,
            (Version, SendParameters, SetByteOrder, StopStreaming),
        )
        probe = next((answered[kind] for kind in kinds if kind in answered), None)
        if self._requested is not None and (probe is None or isinstance(probe, StopStreaming)):
            probe = self._requested  # the server accepted it, so it answers it again
        if probe is None:
            return  # The server answers nothing, and nothing is requested of it.
        try:
            await self._session.ask(probe)
        except ServerError:
            pass
        except ReplyTimeoutError as error:
            raise SilenceError(f"{error}, and sends no frames; connecting again") from None

    async def _ask_again(self, requested: StreamFrames) -> None:
        server, rejection = self._session.server, self._session.rejection
        text = f"{server} accepted {requested} and sends neither frames nor No Data"
        if rejection:
            text = f"all frames from {server} are rejected: {rejection}"
        if self._asked_again:
            raise SilenceError(f"{text}, although the gateway asked again; connecting again")
        self._status.events.log(logging.INFO, f"{text}; asking again", "asking again")
        if await self._request(requested) is not _Outcome.ACCEPTED:
            raise RequestError(f"{server} no longer accepts {requested}; connecting again")
        self._asked_again = True

    async def _request_any(self, forms: Sequence[StreamFrames]) -> None:
        """Request frames in one form after the other, until the server accepts one or sends frames."""
        session = self._session
        has_answered = bool(session.replies.answered)
        ignored: list[StreamFrames] = []
        for form in forms:
            outcome = await self._request(form)
            if outcome is _Outcome.ACCEPTED:
                self.accepted = form
                break
            if outcome is _Outcome.NO_ANSWER:
                ignored.append(form)
        else:
            # A late refusal need not say what it refuses, so the server may have accepted a form after all.
            if not (self._is_slow and await session.wait_for_data(self._source.reply_timeout_s)):
                text = f"{session.server} accepts connections and answers no command; restart its application"
                if session.replies.answered:
                    verb = "refuses or ignores" if self._is_slow else "refuses"
                    text = (
                        f"{session.server} {verb} StreamFrames in every form that the protocol has; "
                        "check its real-time output settings"
                    )
                raise RequestError(text)
            self.accepted = self._requested = forms[-1]
        if ignored and (not has_answered or ignored[0].components != self.accepted.components):
            # The server was not answering at all, or may have hung for a moment, so it may know the form that
            # it seemed to ignore. Without names, components of other rates have to share this connection.
            if await self._request(ignored[0]) is _Outcome.ACCEPTED:
                self.accepted = ignored[0]
            else:
                await self._request(self.accepted)

    async def _request(self, request: StreamFrames) -> _Outcome:
        """Request frames, and keep the request if the server accepts it.

        If the server sends data without having sent any before, it has accepted the request.
        """
        self._asked_again = False
        had_data = self._session.has_data
        outcome = await self._ask(request)
        if outcome is _Outcome.NO_ANSWER and not had_data and self._session.has_data:
            outcome = _Outcome.ACCEPTED
        if outcome is _Outcome.ACCEPTED:
            self._requested = request
            self._status.rate = "" if request.rate is None else str(request.rate)
        return outcome

    async def _fetch_parameters(self) -> Parameters | None:
        """Return the server's parameters; None if there are none."""
        try:
            parsed = await self._read_parameters(self._session)
        except ServerError as error:
            self._status.add_limitation(f"the server refused {SendParameters()}: {error}")
        except ReplyTimeoutError:
            self._is_slow = True
            self._status.add_limitation(UNANSWERED)
        except ParametersError as error:
            self._status.add_limitation(f"no parameters: {error}")
        else:
            if parsed.recovered:
                self._status.parameters_repaired(parsed.recovered)
            return parsed.parameters
        return None

    async def _ask(self, command: Command) -> _Outcome:
        """Send ``command``; if the server refuses or does not answer, add the limitation."""
        try:
            await self._session.ask(command)
        except ServerError as error:
            self._status.add_limitation(f"the server refused {command}: {error}")
            return _Outcome.REFUSED
        except ReplyTimeoutError:
            self._is_slow = True
            verb = "acknowledge" if isinstance(command, StreamFrames) else "answer"
            self._status.add_limitation(f"the server did not {verb} {command}")
            return _Outcome.NO_ANSWER
        return _Outcome.ACCEPTED


DEMAND_POLL_S: Final = 0.05
"""How often an on-demand stream checks for subscribers. It polls because a notification could be missed."""

FIRST_RETRY_S: Final = 1.0
"""How long to wait before a refused stop or resume is repeated. Each wait is twice as long as the last."""

MAX_RESUMES: Final = 4
"""How often a resume may be refused, in a row, before the connection ends."""

_MAX_RETRY_S: Final = 30.0

logger = logging.getLogger(__name__)


class StreamTarget:
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
        requests: StreamRequests,
        has_subscribers: Callable[[], bool],
    ) -> None:
        self._source = source
        self._stream = stream
        self._status = status
        self._session = session
        self._requests = requests
        self._has_subscribers = has_subscribers
        self._is_wanted = True
        self._halvings = 0  # as wanted
        self._requested_halvings = 0  # in the newest request for another rate
        self._components: Sequence[ComponentType] | None = None  # to request instead of the former ones
        self._changed = asyncio.Event()  # _is_wanted, _halvings or _components
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Start to change the stream as needed. Call it after the handshake."""
        works = (
            [self._apply_changes, self._follow_demand] if self._stream.on_demand else [self._apply_changes]
        )
        self._tasks = [asyncio.create_task(self._run_until_error(work)) for work in works]

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
        return not (self._requests.is_stopped or self._halvings or self._requested_halvings)

    def cancel(self) -> None:
        """Cancel all tasks."""
        for task in self._tasks:
            task.cancel()

    async def _run_until_error(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a task; end the session if it fails, because then nothing changes the stream any more."""
        try:
            # Called here: a task that is cancelled before it starts must leave no coroutine behind.
            await work()
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
        requests = self._requests
        if not self._is_wanted:
            if not requests.is_stopped:
                if not await requests.stop():
                    return False
                self._status.events.log(logging.INFO, "no subscribers; the stream is stopped", "demand")
            return True
        if requests.is_stopped:
            self._status.events.log(
                logging.INFO, "a subscriber appeared; frames are requested again", "demand"
            )
            return await self._request_rate()
        if self._components is not None:
            components, self._components = self._components, None
            self._requested_halvings = 0
            await requests.request_components(components)
        if self._halvings != self._requested_halvings:
            lag_s = self._status.lag_s
            await self._request_rate()  # if the server refuses, it keeps the rate, and may accept another one
            request = f"asked the server for {self._status.rate or 'its default rate'}"
            if 1000 * lag_s > self._source.max_lag_ms:
                self._status.frames_late(lag_s, running_clock().longest_delay_s(), request)
            elif self._halvings:
                logger.debug("%s: frames arrive in time; %s", self._status.name, request)
            else:
                self._status.frames_in_time(f"; {request}")
        return True

    async def _request_rate(self) -> bool:
        self._requested_halvings = self._halvings
        return await self._requests.request(self._halvings)

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
