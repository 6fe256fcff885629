"""Requests from LCM and their replies, whatever they ask for.

Anybody on the network can send on LCM, and LCM has no flow control. So the thread that receives requests
admits or refuses them. Malformed ones are counted and ignored.
"""

import asyncio
import contextlib
import functools
import logging
import math
import secrets
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final, NamedTuple

import lcm
import rtc3d

from gateway.errors import OutputError, QueryError
from gateway.messages.decode import JSON, LCM_MESSAGES, json_bytes
from gateway.messages.history import unpack_messages
from gateway.messages.texts import xml_text
from gateway.messages.topics import MAX_CHANNEL_LENGTH, escape_key_chunk, lcm_channel
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION, STOP, QueryService
from gateway.outputs.lcm.receiver import MAX_PENDING, LcmReceiver
from gateway.outputs.lcm.sender import LcmSender, LcmThreadSender, new_sender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.other_gateways import OtherGateways
from gateway.outputs.query_admission import QueryAdmission, QueryDefects, QueryLimits, Refusal
from gateway.runtime.failures import log_fields
from gateway.runtime.losses import Losses
from gateway.runtime.safe_text import quoted
from gateway.runtime.workers import WorkerThread

LONG_REPLY_BYTES: Final = 32 * 1024
"""Longer contents are encoded and sent by a thread: 16 MB take 30 ms."""

MAX_REQUEST_BYTES: Final = 4096
MAX_REQUESTER_BYTES: Final = 128

HISTORY: Final = "history"
"""The command that asks for messages again. Its option ``key`` is that of the messages on Zenoh."""

_STOP_OPTION: Final = f"{CONTROL_OPTION}={STOP}".encode()

_REFILL: Final = "_REFILL"

_REFILL_BURST_S: Final = 0.002
"""How far messages that are sent again may be ahead of their pace."""

PRESENCE_S: Final = 5.0
"""How often a gateway shows itself to others on the URL of requests."""

_PRESENCE: Final = "GATEWAY"
_PRESENCE_FINGERPRINT: Final[bytes] = rtc3d.command_request_t._get_packed_fingerprint()  # noqa: SLF001 - see decode.py

MAX_REMEMBERED: Final = 64
"""How many commands are remembered with their results, for requests that are repeated."""

logger = logging.getLogger(__name__)


class ReplyContent(NamedTuple):
    """What a reply contains, of ``num_bytes``. ``fill`` writes it to the reply, maybe in another thread.

    ``messages`` follow the reply on a channel of their own.
    """

    num_bytes: int
    fill: Callable[[Any], None]
    messages: tuple[str, list[bytes]] = ("", [])


class RequestKind(NamedTuple):
    """One kind of requests: its types, and the coroutine that answers one about a source.

    Requests come on PREFIX_SOURCE_NAME_REQUEST, replies go to PREFIX_SOURCE_NAME_REPLY. Both types have
    ``request_id`` and ``requester``, and the reply has ``error`` and ``error_code``. ``answer`` raises
    QueryError.
    """

    name: str
    request: type[Any]
    reply: type[Any]
    answer: Callable[[str, Any], Awaitable[ReplyContent]]


class LcmRequests:
    """Answers requests for parameters, and commands, with ``service``. They share all limits.

    Requests and replies use ``queries_url``, where a thread of this object receives. If that is the output's
    own URL, ``sender`` sends the replies; and if there is a ``shared`` LCM object (memq://), its owner
    receives. ``losses`` counts what is lost, by source.
    """

    def __init__(
        self,
        settings: LcmSettings,
        service: QueryService,
        loop: asyncio.AbstractEventLoop,
        sender: LcmSender | LcmThreadSender,
        shared: lcm.LCM | None,
        losses: Mapping[str, Losses],
    ) -> None:
        self._prefix = settings.prefix
        self._service = service
        self._loop = loop
        self._losses = losses
        self._kinds = (
            RequestKind(
                *("PARAMETERS", rtc3d.parameters_request_t, rtc3d.parameters_reply_t, self._answer_parameters)
            ),
            RequestKind("COMMAND", rtc3d.command_request_t, rtc3d.command_reply_t, self._answer_command),
        )
        url = settings.effective_queries_url
        is_own_url = url != settings.effective_url
        self._own_sender = new_sender(url, None, lambda: None, "replies") if is_own_url else None
        self._sender = self._own_sender or sender
        self.receiver = LcmReceiver(
            *(url, settings.prefix, None if is_own_url else shared),
            on_open=self._own_sender.open if self._own_sender is not None else lambda: None,
        )
        self.long_sender = WorkerThread("lcm-send-long")
        """Makes and sends what is long."""
        self.admission = QueryAdmission(
            QueryLimits.of("lcm", "max_queries_per_source_per_s", settings, MAX_PENDING)
        )
        self.others = OtherGateways("lcm", expires_s=3 * PRESENCE_S)
        """Other gateways that answer requests about the same sources."""
        self._id = secrets.token_hex(8)
        self._sources: dict[str, None] = {}  # those of which requests are answered
        self._shown_s = -math.inf
        self._tasks: set[asyncio.Task[None]] = set()
        self._remembered: OrderedDict[tuple[Any, ...], asyncio.Task[ReplyContent]] = OrderedDict()
        self._defects = QueryDefects(logger)
        self._is_receiving = settings.queries
        self._refill_bytes_per_s = settings.max_reply_bytes_per_s
        self._is_refilling = False

    def add(self, source: str) -> None:
        """Answer requests about one more source, while ``service`` serves it."""
        for kind in self._kinds:
            channel = lcm_channel(self._prefix, source, f"{kind.name}_REQUEST")
            self.receiver.add(channel, functools.partial(self._take, kind, source))
        self._sources[source] = None
        self.receiver.add(self._presence_channel(source), functools.partial(self._take_presence, source))

    def maintain(self) -> None:
        """See LcmSender. Show this gateway to others that have sources of the same names."""
        if self._own_sender is not None:
            self._own_sender.maintain()
        self.others.check()
        now_s = time.monotonic()
        if now_s - self._shown_s >= PRESENCE_S and self._is_receiving:
            self._shown_s = now_s
            for source in filter(self._service.serves, self._sources):
                self._show_presence(source)

    def _presence_channel(self, source: str) -> str:
        return lcm_channel(self._prefix, source, _PRESENCE)

    def _show_presence(self, source: str) -> None:
        message = rtc3d.command_request_t()
        message.requester = self._id
        with contextlib.suppress(OutputError):  # replies cannot be sent either, which is counted then
            self._sender.send(self._presence_channel(source), message.encode())

    async def close(self) -> None:
        """Stop receiving requests. Those in progress get no reply."""
        await self.receiver.close()
        for task in (*self._remembered.values(), *self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.long_sender.close()
        if self._own_sender is not None:
            await WorkerThread("close lcm replies").run(self._own_sender.close)  # may wait for a peer

    # In the receiving thread.

    def _take(self, kind: RequestKind, source: str, data: bytes) -> None:
        """Check a request and pass it to the event loop."""
        if len(data) > MAX_REQUEST_BYTES or data[:8] != kind.request._get_packed_fingerprint():  # noqa: SLF001 - see decode.py
            self._count_malformed(kind, source, data)
            return
        is_stop = _STOP_OPTION in data  # before it is decoded, which costs more
        refusal = self.admission.admit(source, source, is_stop=is_stop)
        if refusal is not None:
            self._refuse(kind, source, data, refusal)
            return
        request = _decoded(kind, data)
        if request is None:
            self.admission.finished(source, "")
            self._count_malformed(kind, source, data)
            return
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(self._start_answer, kind, source, request)

    def _take_presence(self, source: str, data: bytes) -> None:
        """Note that another gateway answers requests about a source."""
        if len(data) <= MAX_REQUEST_BYTES:
            try:
                gateway = str(rtc3d.command_request_t.decode(data).requester)
            except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
                return
            if gateway != self._id and self._service.serves(source):
                self.others.seen(source, gateway)

    def _count_malformed(self, kind: RequestKind, source: str, data: bytes) -> None:
        self._losses[source].lost(
            "malformed request",
            f"a message on the channel of requests is ignored: {len(data)} bytes that are no "
            f"{kind.request.__name__}; correct the program that sends it",
            frames=0,
        )

    def _refuse(self, kind: RequestKind, source: str, data: bytes, refusal: Refusal) -> None:
        if refusal.cause == "queue":
            self._losses[source].lost(
                "request beyond the queue",
                f"a request on LCM is ignored, because {MAX_PENDING} others are in progress; "
                "ask less often, or subscribe to the parameters",
                frames=0,
            )
            return
        error = refusal.error
        self._losses[source].lost("request beyond the rate", f"a request is refused: {error}", frames=0)
        request = _decoded(kind, data) if refusal.is_sent else None
        if request is not None:
            self.long_sender.offer(functools.partial(self._send_error, kind, source, request, error))

    # In the event loop.

    def _start_answer(self, kind: RequestKind, source: str, request: Any) -> None:
        if not self._service.serves(source):
            self.admission.finished(source, "")
            return
        with log_fields(source=source):
            task = asyncio.create_task(self._answer(kind, source, request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, kind: RequestKind, source: str, request: Any) -> None:
        content: ReplyContent | QueryError | None = None
        try:
            content = await kind.answer(source, request)
            self.admission.check_reply(content.num_bytes)
        except QueryError as error:
            content = error
        except Exception as defect:  # noqa: BLE001 - every request gets a reply
            query = f"LCM request {request.request_id} of {request.requester!r}"
            content = self._defects.log(source, defect, query)
        finally:
            # Before the reply is sent: its receiver may ask again at once. Cancelled, it has no result.
            result = "" if content is None else content.code if isinstance(content, QueryError) else "ok"
            self.admission.finished(source, result)
        if isinstance(content, QueryError):
            self._send_error(kind, source, request, content)
            return
        send = functools.partial(self._send_reply, kind, source, request, content.fill)
        channel, messages = content.messages
        if messages:
            self._is_refilling = True
            refill = functools.partial(self._refill, source, send, channel, messages)
            if not self.long_sender.offer(refill, content.num_bytes):
                self._is_refilling = False
                self._drop_reply(kind, source, request)
        elif content.num_bytes <= LONG_REPLY_BYTES:
            send()
        elif not self.long_sender.offer(send, content.num_bytes):
            self._drop_reply(kind, source, request)

    def _drop_reply(self, kind: RequestKind, source: str, request: Any) -> None:
        """Count a long reply that is not sent, and send an error, which is short, instead."""
        self._losses[source].lost(
            "reply beyond the queue",
            "a reply on LCM is dropped, because earlier ones wait to be sent; ask less often",
            frames=0,
        )
        error = QueryError("earlier replies wait to be sent; try again", code="busy")
        self._send_error(kind, source, request, error)

    async def _answer_parameters(self, source: str, request: Any) -> ReplyContent:
        parameters = await self._service.parameters(source, request.sections, fresh=request.fresh)

        def fill(reply: Any) -> None:
            reply.xml, reply.age_s = xml_text(parameters.xml), parameters.age_s
            reply.parameters_version = parameters.version

        return ReplyContent(len(parameters.xml), fill)

    async def _answer_command(self, source: str, request: Any) -> ReplyContent:
        """Return the answer to a command.

        Requests and replies can be lost on LCM, so their senders repeat them. A command that changes
        something is carried out once nevertheless: equal requests get the result of the first.
        """
        options = {}
        for option in request.options:
            name, separator, value = option.partition("=")
            if not separator:
                raise QueryError(f"option {quoted(option)} is not accepted; accepted: NAME=VALUE")
            options[name] = value
        if CONTROL_OPTION not in options:
            return await self._carry_out(source, request.command, options)
        identity = (source, request.request_id, request.requester, request.command, *request.options)
        task = self._remembered.get(identity)
        if task is None:
            task = asyncio.create_task(self._carry_out(source, request.command, options))
            self._remembered[identity] = task
            task.add_done_callback(lambda done: self._finish(identity, done))
        return await asyncio.shield(task)

    def _finish(self, identity: tuple[Any, ...], task: asyncio.Task[ReplyContent]) -> None:
        """Forget a command that failed, because it may be tried again, and the oldest of too many."""
        if task.cancelled() or task.exception() is not None:
            del self._remembered[identity]
        while len(self._remembered) > MAX_REMEMBERED:
            self._remembered.popitem(last=False)

    async def _carry_out(self, source: str, command: str, options: dict[str, str]) -> ReplyContent:
        if command == HISTORY and "key" in options:
            return await self._find_messages(source, options)
        if command not in (HISTORY, *self._service.commands()):
            accepted = ", ".join((HISTORY, *self._service.commands()))
            raise QueryError(f"unknown command {quoted(command)}; accepted on LCM: {accepted}")
        if READ_OPTION in options:
            raise QueryError(
                f"{command} with {READ_OPTION}= is not answered on LCM; ask on Zenoh (a take: rtc3d-gateway "
                "take fetch, without --lcm)"
            )
        answer = await self._service.answer(source, tuple(command.split("/")), options)
        content = answer.content
        if answer.encoding != JSON or not isinstance(content, bytes):
            raise QueryError(f"the answer to {command} with these options is no JSON; ask on Zenoh")

        def fill(reply: Any) -> None:
            reply.content = content.decode()

        return ReplyContent(len(content), fill)

    async def _find_messages(self, source: str, options: dict[str, str]) -> ReplyContent:
        """Return messages of the history. Those that the peer asks for go to everybody, so one at a time."""
        key = options.pop("key")
        self._check_nobody_is_refilled()
        component, separator, tool = key.partition("/")
        names = (component, tool) if separator else (component,)
        path = (component, escape_key_chunk(tool)) if separator else names
        answer = await self._service.answer(source, path, options)
        if not answer.encoding.startswith(LCM_MESSAGES):
            raise QueryError(f"{HISTORY} with key= needs one of from=, last_s=, since_utime=")
        self._check_nobody_is_refilled()  # the disk may have taken a while
        channel = refill_channel(lcm_channel(self._prefix, source, *names))
        facts = json_bytes({"key": key, "channel": channel, **answer.attachment}).decode()

        def fill(reply: Any) -> None:
            reply.content = facts

        return ReplyContent(answer.num_bytes, fill, (channel, unpack_messages(answer.payload)))

    def _check_nobody_is_refilled(self) -> None:
        if self._is_refilling:
            text = "messages are being sent again for another subscriber; try again"
            raise QueryError(text, code="busy")

    # In the thread that sends what is long.

    def _refill(self, source: str, reply: Callable[[], None], channel: str, messages: list[bytes]) -> None:
        """Send a reply, and then messages again, no faster than replies may be."""
        try:
            reply()
            pace_s = time.monotonic()
            for message in messages:
                self._sender.send(channel, message)
                pace_s += len(message) / self._refill_bytes_per_s
                if (wait_s := pace_s - time.monotonic()) > _REFILL_BURST_S:
                    time.sleep(wait_s)
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)
        finally:
            self._is_refilling = False

    # In the event loop, or in the thread that sends what is long.

    def _send_error(self, kind: RequestKind, source: str, request: Any, error: QueryError) -> None:
        def fill(reply: Any) -> None:
            reply.error, reply.error_code = str(error), error.code

        self._send_reply(kind, source, request, fill)

    def _send_reply(self, kind: RequestKind, source: str, request: Any, fill: Callable[[Any], None]) -> None:
        reply = kind.reply()
        reply.request_id, reply.requester = request.request_id, request.requester
        fill(reply)
        try:
            self._sender.send(lcm_channel(self._prefix, source, f"{kind.name}_REPLY"), reply.encode())
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)


def is_presence(channel: str, message: bytes) -> bool:
    """Return whether a gateway shows itself to others with this message, which is for no subscriber.

    The poses of a tool of that name are on such a channel, too.
    """
    return message[:8] == _PRESENCE_FINGERPRINT and channel.endswith(f"_{_PRESENCE}")


def refill_channel(channel: str) -> str:
    """Return the channel on which messages of ``channel`` are sent again, on the URL of requests."""
    return channel[: MAX_CHANNEL_LENGTH - len(_REFILL)] + _REFILL


def _decoded(kind: RequestKind, data: bytes) -> Any | None:
    """Return ``data`` as a request; None if it is malformed."""
    try:
        request = kind.request.decode(data)
    except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
        return None
    return request if len(request.requester.encode()) <= MAX_REQUESTER_BYTES else None
