"""Requests from LCM and their replies, whatever they ask for.

Anybody on the network can send on LCM, and LCM has no flow control. So the thread that receives requests
admits or refuses them. Malformed ones are counted and ignored.
"""

import asyncio
import contextlib
import functools
import logging
from collections import OrderedDict, defaultdict
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import rtc3d

from gateway.errors import OutputError, QueryError
from gateway.logs.failures import log_fields
from gateway.logs.losses import Losses
from gateway.logs.safe_text import quoted
from gateway.messages.decode import JSON
from gateway.messages.texts import xml_text
from gateway.messages.topics import lcm_channel
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION, QueryService
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.query_admission import QueryAdmission, QueryDefects, QueryLimits, Refusal
from gateway.workers import WorkerThread

MAX_PENDING: Final = 64
"""The maximum number of requests in progress. Further ones are dropped and counted."""

LONG_REPLY_BYTES: Final = 32 * 1024
"""Longer contents are encoded and sent by a thread: 16 MB take 30 ms."""

MAX_REQUEST_BYTES: Final = 4096
MAX_REQUESTER_BYTES: Final = 128

logger = logging.getLogger(__name__)


class ReplyContent(NamedTuple):
    """What a reply contains, of ``num_bytes``. ``fill`` writes it to the reply, maybe in another thread."""

    num_bytes: int
    fill: Callable[[Any], None]


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
    """Answers requests of several ``kinds``, which share all limits. ``send`` raises OutputError.

    ``long_sender`` makes and sends long replies.
    """

    def __init__(
        self,
        settings: LcmSettings,
        service: QueryService,
        loop: asyncio.AbstractEventLoop,
        kinds: Sequence[RequestKind],
        send: Callable[[str, bytes], None],
        long_sender: WorkerThread,
    ) -> None:
        self._prefix = settings.prefix
        self._service = service
        self._loop = loop
        self._kinds = kinds
        self._send = send
        self._long_sender = long_sender
        self._admission = QueryAdmission(
            QueryLimits(
                output="lcm",
                key_setting="max_queries_per_source_per_s",
                per_s=settings.max_queries_per_s,
                per_key_per_s=settings.max_queries_per_source_per_s,
                reply_bytes_per_s=settings.max_reply_bytes_per_s,
                pending=MAX_PENDING,
            )
        )
        self.losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, "lcm"))
        """What is lost, by source."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._defects = QueryDefects(logger)

    @property
    def results(self) -> Mapping[str, Mapping[str, int]]:
        """See QueryAdmission."""
        return self._admission.results

    def channels(self, source: str) -> dict[str, Callable[[bytes], None]]:
        """Return the channels of requests about a source, each with the function that takes a message."""
        return {
            lcm_channel(self._prefix, source, f"{kind.name}_REQUEST"): functools.partial(
                self._take, kind, source
            )
            for kind in self._kinds
        }

    async def close(self) -> None:
        """Cancel the requests in progress. They get no reply."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # In the receiving thread.

    def _take(self, kind: RequestKind, source: str, data: bytes) -> None:
        """Check a request and pass it to the event loop."""
        if len(data) > MAX_REQUEST_BYTES or data[:8] != kind.request._get_packed_fingerprint():  # noqa: SLF001 - see decode.py
            self._count_malformed(kind, source, data)
            return
        refusal = self._admission.admit(source, source)
        if refusal is not None:
            self._refuse(kind, source, data, refusal)
            return
        request = _decoded(kind, data)
        if request is None:
            self._admission.finished(source, "")
            self._count_malformed(kind, source, data)
            return
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(self._start_answer, kind, source, request)

    def _count_malformed(self, kind: RequestKind, source: str, data: bytes) -> None:
        self.losses[source].lost(
            "malformed request",
            f"a message on the channel of requests is ignored: {len(data)} bytes that are no "
            f"{kind.request.__name__}; correct the program that sends it",
            frames=0,
        )

    def _refuse(self, kind: RequestKind, source: str, data: bytes, refusal: Refusal) -> None:
        if refusal.cause == "queue":
            self.losses[source].lost(
                "request beyond the queue",
                f"a request on LCM is ignored, because {MAX_PENDING} others are in progress; "
                "ask less often, or subscribe to the parameters",
                frames=0,
            )
            return
        error = refusal.error
        self.losses[source].lost("request beyond the rate", f"a request is refused: {error}", frames=0)
        request = _decoded(kind, data) if refusal.is_sent else None
        if request is not None:
            self._long_sender.offer(functools.partial(self._send_error, kind, source, request, error))

    # In the event loop.

    def _start_answer(self, kind: RequestKind, source: str, request: Any) -> None:
        if not self._service.serves(source):
            self._admission.finished(source, "")
            return
        with log_fields(source=source):
            task = asyncio.create_task(self._answer(kind, source, request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, kind: RequestKind, source: str, request: Any) -> None:
        content: ReplyContent | QueryError | None = None
        try:
            content = await kind.answer(source, request)
            self._admission.check_reply(content.num_bytes)
        except QueryError as error:
            content = error
        except Exception as defect:  # noqa: BLE001 - every request gets a reply
            query = f"LCM request {request.request_id} of {request.requester!r}"
            content = self._defects.log(source, defect, query)
        finally:
            # Before the reply is sent: its receiver may ask again at once. Cancelled, it has no result.
            result = "" if content is None else content.code if isinstance(content, QueryError) else "ok"
            self._admission.finished(source, result)
        if isinstance(content, QueryError):
            self._send_error(kind, source, request, content)
        else:
            self._send_content(kind, source, request, content)

    def _send_content(self, kind: RequestKind, source: str, request: Any, content: ReplyContent) -> None:
        send = functools.partial(self._send_reply, kind, source, request, content.fill)
        if content.num_bytes <= LONG_REPLY_BYTES:
            send()
        elif not self._long_sender.offer(send, content.num_bytes):
            self.losses[source].lost(
                "reply beyond the queue",
                "a reply on LCM is dropped, because earlier ones wait to be sent; ask less often",
                frames=0,
            )

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
            self._send(lcm_channel(self._prefix, source, f"{kind.name}_REPLY"), reply.encode())
        except OutputError as error:
            self.losses[source].lost(error.cause, str(error), frames=0)


def _decoded(kind: RequestKind, data: bytes) -> Any | None:
    """Return ``data`` as a request; None if it is malformed."""
    try:
        request = kind.request.decode(data)
    except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
        return None
    return request if len(request.requester.encode()) <= MAX_REQUESTER_BYTES else None


def parameter_requests(service: QueryService) -> RequestKind:
    """Return the requests for parameters, which ``service`` answers."""

    async def answer(source: str, request: Any) -> ReplyContent:
        parameters = await service.parameters(source, request.sections, fresh=request.fresh)

        def fill(reply: Any) -> None:
            reply.xml, reply.age_s = xml_text(parameters.xml), parameters.age_s
            reply.parameters_version = parameters.version

        return ReplyContent(len(parameters.xml), fill)

    return RequestKind("PARAMETERS", rtc3d.parameters_request_t, rtc3d.parameters_reply_t, answer)


MAX_REMEMBERED: Final = 64
"""How many commands are remembered with their results, for requests that are repeated."""

_Identity = tuple[Any, ...]


class LcmCommands:
    """Answers ``command_request_t`` with ``service``.

    Requests and replies can be lost on LCM, so their senders repeat them. A command that changes something is
    carried out once nevertheless: equal requests get the result of the first.
    """

    def __init__(self, service: QueryService) -> None:
        self.kind = RequestKind("COMMAND", rtc3d.command_request_t, rtc3d.command_reply_t, self._answer_once)
        """The requests that ``service`` answers."""
        self._service = service
        self._remembered: OrderedDict[_Identity, asyncio.Task[ReplyContent]] = OrderedDict()

    def close(self) -> None:
        """Cancel the commands in progress."""
        for task in self._remembered.values():
            task.cancel()

    async def _answer_once(self, source: str, request: Any) -> ReplyContent:
        options = _options(request)
        if CONTROL_OPTION not in options:
            return await self._answer(source, request.command, options)
        identity = (source, request.request_id, request.requester, request.command, *request.options)
        task = self._remembered.get(identity)
        if task is None:
            task = asyncio.create_task(self._answer(source, request.command, options))
            self._remembered[identity] = task
            task.add_done_callback(lambda done: self._finish(identity, done))
        return await asyncio.shield(task)

    def _finish(self, identity: _Identity, task: asyncio.Task[ReplyContent]) -> None:
        """Forget a command that failed, because it may be tried again, and the oldest of too many."""
        if task.cancelled() or task.exception() is not None:
            del self._remembered[identity]
        while len(self._remembered) > MAX_REMEMBERED:
            self._remembered.popitem(last=False)

    async def _answer(self, source: str, command: str, options: dict[str, str]) -> ReplyContent:
        if command not in self._service.commands():
            accepted = ", ".join(self._service.commands())
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


def _options(request: Any) -> dict[str, str]:
    """Return the options by name. Raises QueryError if one is no NAME=VALUE."""
    options = {}
    for option in request.options:
        name, separator, value = option.partition("=")
        if not separator:
            raise QueryError(f"option {quoted(option)} is not accepted; accepted: NAME=VALUE")
        options[name] = value
    return options
