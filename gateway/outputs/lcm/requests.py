"""Requests from LCM, whatever they ask for: from a message that arrives to its answer.

Anybody on the network can send on LCM, and LCM has no flow control. So the thread that receives requests
admits or refuses them. Malformed ones are counted and ignored.
"""

import asyncio
import contextlib
import functools
import logging
from collections.abc import Mapping
from typing import Any, Final

import lcm
import rtc3d

from gateway.errors import QueryError
from gateway.messages.texts import xml_text
from gateway.messages.topics import lcm_channel
from gateway.outputs.contract import CONTROL_OPTION, STOP, QueryService
from gateway.outputs.lcm.commands import LcmCommands
from gateway.outputs.lcm.presence import GatewayPresence
from gateway.outputs.lcm.receiver import MAX_PENDING, MAX_REQUEST_BYTES, LcmReceiver
from gateway.outputs.lcm.replies import LcmReplies, ReplyContent, RequestKind
from gateway.outputs.lcm.sender import LcmSender, LcmThreadSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.query_admission import QueryAdmission, QueryDefects, QueryLimits, Refusal
from gateway.runtime.failures import log_fields
from gateway.runtime.losses import Losses

MAX_REQUESTER_BYTES: Final = 128

_STOP_OPTION: Final = f"{CONTROL_OPTION}={STOP}".encode()

logger = logging.getLogger(__name__)


class LcmRequests:
    """Answers requests for parameters, and commands, with ``service``. They share all limits.

    Requests and replies use ``queries_url``, where a thread of this object receives. If that is the output's
    own URL and there is a ``shared`` LCM object (memq://), its owner receives instead. ``sender`` is that of
    the output (see LcmReplies). ``losses`` counts what is lost, by source.
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
        self.replies = LcmReplies(settings, sender, losses)
        self._commands = LcmCommands(settings.prefix, service, self.replies.check_nobody_is_refilled)
        self._kinds = (
            RequestKind(
                *("PARAMETERS", rtc3d.parameters_request_t, rtc3d.parameters_reply_t, self._answer_parameters)
            ),
            RequestKind("COMMAND", rtc3d.command_request_t, rtc3d.command_reply_t, self._commands.answer),
        )
        self.receiver = LcmReceiver(
            *(settings.effective_queries_url, settings.prefix),
            shared=None if settings.has_own_queries_url else shared,
            on_open=self.replies.open,
        )
        self.admission = QueryAdmission(
            QueryLimits.of("lcm", "max_queries_per_source_per_s", settings, MAX_PENDING)
        )
        self.presence = GatewayPresence(settings, self.replies.sender, service.serves)
        self._tasks: set[asyncio.Task[None]] = set()
        self._defects = QueryDefects(logger)

    def add(self, source: str) -> None:
        """Answer requests about one more source, while ``service`` serves it."""
        for kind in self._kinds:
            channel = lcm_channel(self._prefix, source, f"{kind.name}_REQUEST")
            self.receiver.add(channel, functools.partial(self._take, kind, source))
        self.presence.add(source, self.receiver)

    def maintain(self) -> None:
        """See LcmSender. Show this gateway to others that have sources of the same names."""
        self.replies.maintain()
        self.presence.maintain()

    async def close(self) -> None:
        """Stop receiving requests. Those in progress get no reply."""
        await self.receiver.close()
        self._commands.cancel()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.replies.close()

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
            send = functools.partial(self.replies.send_error, kind, source, request, error)
            self.replies.long_sender.offer(send)

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
            self.replies.send_error(kind, source, request, content)
        else:
            self.replies.send(kind, source, request, content)

    async def _answer_parameters(self, source: str, request: Any) -> ReplyContent:
        parameters = await self._service.parameters(source, request.sections, fresh=request.fresh)

        def fill(reply: Any) -> None:
            reply.xml, reply.age_s = xml_text(parameters.xml), parameters.age_s
            reply.parameters_version = parameters.version

        return ReplyContent(len(parameters.xml), fill)


def _decoded(kind: RequestKind, data: bytes) -> Any | None:
    """Return ``data`` as a request; None if it is malformed."""
    try:
        request = kind.request.decode(data)
    except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
        return None
    return request if len(request.requester.encode()) <= MAX_REQUESTER_BYTES else None
