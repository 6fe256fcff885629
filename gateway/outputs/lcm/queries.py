"""Requests from LCM (parameters_request_t), their replies, and parameters that the gateway publishes.

Anybody on the network can send on LCM, and LCM has no flow control. So the thread that receives requests
admits or refuses them. Malformed ones are counted and ignored.
"""

import asyncio
import contextlib
import functools
import logging
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import Future
from typing import Any, Final

import lcm
import rtc3d

from gateway.errors import OutputError, QueryError
from gateway.log import FailureLog, log_fields
from gateway.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.topics import lcm_channel
from gateway.outputs.admission import Admission, QueryLimits, Refusal
from gateway.outputs.contract import QueryService, ServerParameters
from gateway.outputs.lcm.connection import open_lcm, reconnect, scheme_of, send_problem
from gateway.outputs.lcm.sender import RETRY_S, LcmSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.thread_sender import LcmThreadSender, new_sender
from gateway.outputs.query_defects import QueryDefects
from gateway.outputs.send_thread import SendThread
from gateway.token_bucket import TokenBucket
from gateway.worker_thread import WorkerThread

MAX_PENDING: Final = 64
"""The maximum number of requests in progress. Further ones are dropped and counted."""

RECEIVED_PER_S: Final = 2000.0
"""How many messages a second are received. LCM itself discards further ones, which cannot be counted."""

LONG_XML_BYTES: Final = 32 * 1024
"""Longer parameters are encoded and sent by a thread: 16 MB take 30 ms."""

MAX_REQUEST_BYTES: Final = 4096
MAX_REQUESTER_BYTES: Final = 128
REPEAT_S: Final = 5.0
"""How often the parameters are published again, for late subscribers."""

_POLL_MS: Final = 100
_PAUSE_S: Final = 0.02
_JOIN_S: Final = 0.3

_FINGERPRINT: Final[bytes] = rtc3d.parameters_request_t._get_packed_fingerprint()  # noqa: SLF001 - see decode.py

logger = logging.getLogger(__name__)


class _Publication:
    """A source's newest parameters, and when they are due to be published again.

    ``sent`` is the latest publication by the thread.
    """

    def __init__(self) -> None:
        self.newest: tuple[ServerParameters, int] | None = None  # with the time when they arrived, in µs
        self.sequence = 0
        self.due_s = 0.0
        self.sent: Future[None] | None = None


class LcmQueries:
    """Answers requests on the channels of ``settings.prefix`` with ``service``.

    ``sender`` publishes parameters. Requests and replies use ``queries_url``, where a thread of this object
    receives. If ``queries_url`` is the output's own URL and there is a ``shared`` LCM object (memq://), the
    owner of that object receives instead.
    """

    def __init__(
        self,
        settings: LcmSettings,
        service: QueryService,
        loop: asyncio.AbstractEventLoop,
        sender: LcmSender | LcmThreadSender,
        shared: lcm.LCM | None,
    ) -> None:
        self._prefix = settings.prefix
        self._service = service
        self._loop = loop
        self._sender = sender
        self._url = settings.effective_queries_url
        is_own_url = self._url != settings.effective_url
        self._shared = None if is_own_url else shared
        self._reply_sender = new_sender(self._url, None, lambda: None, "replies") if is_own_url else sender
        self._sources: set[str] = set()
        self._subscriptions: dict[str, lcm.LCMSubscription] = {}  # by the source's name
        self._thread = threading.Thread(target=self._receive, name="lcm-requests", daemon=True)
        self._closing = threading.Event()
        self._opening = FailureLog(logger, "lcm")
        self._received = TokenBucket(RECEIVED_PER_S)  # used in the receiving thread
        self._admission = Admission(
            QueryLimits(
                output="lcm",
                key_setting="max_queries_per_source_per_s",
                per_s=settings.max_queries_per_s,
                per_key_per_s=settings.max_queries_per_source_per_s,
                reply_bytes_per_s=settings.max_reply_bytes_per_s,
                pending=MAX_PENDING,
            )
        )
        self._long_sender = SendThread("lcm-send-long")
        self._losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, "lcm"))  # by source
        self._tasks: set[asyncio.Task[None]] = set()
        self._publications: dict[str, _Publication] = {}
        self._defects = QueryDefects(logger)

    @property
    def results(self) -> Counter[str]:
        """See Admission."""
        return self._admission.results

    def start(self) -> None:
        """Receive requests. Called in any thread, after the output has opened."""
        if self._shared is not None:
            self._subscribe(self._shared)
        else:
            self._thread.start()

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost of ``source``: requests, replies and parameters."""
        self._losses[source] = losses

    def add(self, source: str) -> None:
        """Answer requests about one more source."""
        self._sources.add(source)
        if self._shared is not None:
            self._subscribe(self._shared)

    def remove(self, source: str) -> None:
        """Stop publishing a source's parameters; ``service`` no longer serves requests about it.

        Its subscription stays: LCM's Python module would free it while the receiving thread may be using it.
        """
        self._publications.pop(source, None)

    # In the receiving thread.

    def _receive(self) -> None:
        connection = self._open()
        if connection is not None and self._reply_sender is not self._sender:
            self._reply_sender.open()
        while connection is not None and not self._closing.is_set():
            self._subscribe(connection)
            if self._received.left <= 0:
                self._closing.wait(_PAUSE_S)  # or a flood would keep other threads from running
            try:
                connection.handle_timeout(_POLL_MS)
            except OSError as error:
                logger.debug("receiving LCM requests: %s", error)
                self._closing.wait(_POLL_MS / 1000)
                if scheme_of(self._url) == "tcpq":
                    self._reconnect(connection)

    def _open(self) -> lcm.LCM | None:
        """Return the LCM object that receives requests, with retries; None if ``close`` is called first."""
        while not self._closing.is_set():
            try:
                connection = open_lcm(self._url)
            except OutputError as error:
                self._opening.failed(f"no requests can be received: {error} (this is lcm.queries_url)")
                self._closing.wait(RETRY_S)
                continue
            self._opening.recovered("requests can be received")
            return connection
        return None

    def _reconnect(self, connection: lcm.LCM) -> None:
        """Connect to the relay again, with retries, until ``close``."""
        while not self._closing.is_set():
            try:
                reconnect(connection, f"{self._prefix}_RECONNECTED")
            except OSError as error:
                problem = send_problem(self._url, error)
                self._opening.failed(f"no requests can be received: {problem} (this is lcm.queries_url)")
                self._closing.wait(RETRY_S)
            else:
                self._opening.recovered("requests can be received")
                return

    def _subscribe(self, connection: lcm.LCM) -> None:
        """Subscribe to requests about the sources that are new."""
        for source in self._sources.copy() - self._subscriptions.keys():
            channel = lcm_channel(self._prefix, source, "PARAMETERS_REQUEST")
            subscription = connection.subscribe(f"^{channel}$", self._handler(source))
            subscription.set_queue_capacity(MAX_PENDING)
            self._subscriptions[source] = subscription

    def _handler(self, source: str) -> Any:
        return lambda _channel, data: self._take(source, data)

    def _take(self, source: str, data: bytes) -> None:
        """Check a request and pass it to the event loop."""
        self._received.take()
        if len(data) > MAX_REQUEST_BYTES or data[: len(_FINGERPRINT)] != _FINGERPRINT:
            self._count_malformed(source, data)
            return
        refusal = self._admission.admit(source)
        if refusal is not None:
            self._refuse(source, data, refusal)
            return
        request = _decoded(data)
        if request is None:
            self._admission.finished("")
            self._count_malformed(source, data)
            return
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(self._start_answer, source, request)

    def _count_malformed(self, source: str, data: bytes) -> None:
        self._losses[source].lost(
            "malformed request",
            f"a message on the channel of requests is ignored: {len(data)} bytes that are no "
            "parameters_request_t; correct the program that sends it",
            frames=0,
        )

    def _refuse(self, source: str, data: bytes, refusal: Refusal) -> None:
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
        request = _decoded(data) if refusal.is_sent else None
        if request is not None:
            reply = _reply_to(request)
            reply.error, reply.error_code = str(error), error.code
            self._long_sender.offer(functools.partial(self._send_reply, source, reply))

    # In the event loop.

    def _start_answer(self, source: str, request: Any) -> None:
        if not self._service.serves(source):
            self._admission.finished("")
            return
        with log_fields(source=source):
            task = asyncio.create_task(self._answer(source, request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, source: str, request: Any) -> None:
        reply = _reply_to(request)
        parameters: ServerParameters | None = None
        try:
            parameters = await self._service.parameters(source, request.sections, fresh=request.fresh)
            self._admission.check_reply(len(parameters.xml))
        except QueryError as error:
            parameters, reply.error, reply.error_code = None, str(error), error.code
        except Exception as defect:  # noqa: BLE001 - every request gets a reply
            query = f"LCM request {reply.request_id} of {reply.requester!r}"
            answer = self._defects.log(source, defect, query)
            reply.error, reply.error_code = str(answer), answer.code
        finally:
            # Before the reply is sent: its receiver may ask again at once. Cancelled, it has no result.
            has_result = parameters is not None or reply.error_code
            self._admission.finished((reply.error_code or "ok") if has_result else "")
        self._send_answer(source, reply, parameters)

    def _send_answer(self, source: str, reply: Any, parameters: ServerParameters | None) -> None:
        if parameters is None or len(parameters.xml) <= LONG_XML_BYTES:
            self._send_reply(source, reply, parameters)
            return
        send = functools.partial(self._send_reply, source, reply, parameters)
        if not self._long_sender.offer(send, len(parameters.xml)):
            self._losses[source].lost(
                "reply beyond the queue",
                "a reply on LCM is dropped, because earlier ones wait to be sent; ask less often",
                frames=0,
            )

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish a source's parameters, now and every REPEAT_S seconds.

        Returns a future that is done when long parameters have been sent; None if these have been.
        """
        publication = self._publications.setdefault(source, _Publication())
        publication.newest = parameters, now_utime()
        sent = self._publish_again(source, publication)
        return None if sent is None else asyncio.wrap_future(sent, loop=self._loop)

    def maintain(self) -> None:
        """Publish the parameters again that are due. Called once a second."""
        if self._reply_sender is not self._sender:
            self._reply_sender.maintain()
        for source, publication in self._publications.items():
            if time.monotonic() >= publication.due_s:
                self._publish_again(source, publication)

    def _publish_again(self, source: str, publication: _Publication) -> Future[None] | None:
        publication.due_s = time.monotonic() + REPEAT_S
        waits = publication.sent is not None and not publication.sent.done()
        is_long = publication.newest is not None and len(publication.newest[0].xml) > LONG_XML_BYTES
        if not (waits or is_long):
            self._publish_newest(source, publication)
            return None
        # If one waits to be sent, it may have begun with the former parameters.
        publication.sent = self._long_sender.submit(
            functools.partial(self._publish_newest, source, publication)
        )
        return publication.sent

    # In the event loop, or in the thread that sends what is long.

    def _publish_newest(self, source: str, publication: _Publication) -> None:
        if publication.newest is None:
            return
        parameters, message = publication.newest[0], rtc3d.parameters_t()
        message.utime, message.capture_utime = now_utime(), publication.newest[1]
        message.sequence, publication.sequence = publication.sequence, publication.sequence + 1
        message.session, message.parameters_version = parameters.session, parameters.version
        message.xml = _text(parameters.xml)
        self._publish(self._sender, source, "PARAMETERS", message)

    def _send_reply(self, source: str, reply: Any, parameters: ServerParameters | None = None) -> None:
        if parameters is not None:
            reply.xml, reply.age_s = _text(parameters.xml), parameters.age_s
            reply.parameters_version = parameters.version
        self._publish(self._reply_sender, source, "PARAMETERS_REPLY", reply)

    def _publish(self, sender: LcmSender | LcmThreadSender, source: str, name: str, message: Any) -> None:
        try:
            sender.send(lcm_channel(self._prefix, source, name), message.encode())
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)

    async def close(self) -> None:
        """Stop receiving requests. Pending requests get no reply."""
        self._closing.set()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._long_sender.close()
        if self._thread.is_alive():
            await WorkerThread("join lcm-requests").run(lambda: self._thread.join(_JOIN_S))
        if self._shared is not None:
            for subscription in self._subscriptions.values():
                self._shared.unsubscribe(subscription)
        if self._reply_sender is not self._sender:
            await WorkerThread("close lcm replies").run(self._reply_sender.close)  # may wait for a peer


def _reply_to(request: Any) -> Any:
    reply = rtc3d.parameters_reply_t()
    reply.request_id, reply.requester = request.request_id, request.requester
    return reply


def _decoded(data: bytes) -> Any | None:
    """Return ``data`` as a ``parameters_request_t``; None if it is malformed."""
    try:
        request = rtc3d.parameters_request_t.decode(data)
    except Exception:  # noqa: BLE001 - lcm-gen's decoders raise anything
        return None
    return request if len(request.requester.encode()) <= MAX_REQUESTER_BYTES else None


def _text(xml: bytes) -> str:
    """Return XML as text (UTF-8, otherwise Latin-1), without the NULs at its end (field note 9)."""
    body = xml.rstrip(b"\0")
    try:
        return body.decode()
    except UnicodeDecodeError:
        return body.decode("latin-1")
