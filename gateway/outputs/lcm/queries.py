"""Questions that come on LCM, as parameters_request_t; and parameters told unasked, as parameters_t.

LCM is open to everybody on the network and knows no flow control: requests wait in a bounded queue,
malformed ones are counted and ignored.
"""

import asyncio
import contextlib
import logging
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from typing import Any, Final

import lcm
import rtc3d

from gateway.config.settings import LcmSettings
from gateway.errors import OutputError, QueryError
from gateway.log import log_fields
from gateway.messages.host_time import now_utime
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.output import open_lcm
from gateway.queries.answers import unknown_section
from gateway.queries.source_queries import SourceQueries
from gateway.rtc3d.parameters import SECTIONS

MAX_PENDING: Final = 64
"""How many requests are worked on at once; more are dropped and counted."""

MAX_REQUEST_BYTES: Final = 4096
MAX_REQUESTER_BYTES: Final = 128
REPEAT_S: Final = 5.0
"""How often the parameters are published again, for those who came late."""

_MALFORMED: Final = "malformed request"
_BEYOND: Final = "request beyond the queue"
"""What ignored requests are counted as."""

_POLL_MS: Final = 100
_JOIN_S: Final = 1.0

logger = logging.getLogger(__name__)


class _Told:
    """A source's newest parameters, and when they are to be published again."""

    def __init__(self) -> None:
        self.message = rtc3d.parameters_t()
        self.again_at_s = 0.0


class LcmQueries:
    """Answers for all ``desks``, by the source's name, on the channels of ``settings.prefix``.

    The desks may change: ``serve`` and ``dismiss`` tell of one that came or went. ``drops`` are the
    counters, by the source's name, of what was not answered. ``declare`` is called once LCM is open.
    Where ``shared`` is true somebody else handles that LCM object, as with memq://; else a thread of
    this object does.
    """

    def __init__(
        self,
        settings: LcmSettings,
        desks: Mapping[str, SourceQueries],
        drops: Mapping[str, Counter[str]],
        *,
        shared: bool,
    ) -> None:
        self._prefix = settings.prefix
        self._desks = desks
        self._drops = drops
        self._shared = shared
        self._loop = asyncio.get_running_loop()
        self._url, self._queries_url = settings.effective_url, settings.effective_queries_url
        self._lcm: lcm.LCM | None = None
        self._asked: lcm.LCM | None = None  # where requests come and replies go
        self._subscriptions: dict[str, lcm.LCMSubscription] = {}  # by the source's name
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._free = threading.BoundedSemaphore(MAX_PENDING)  # taken in the handler's thread
        self._ignored: dict[str, Counter[str]] = defaultdict(Counter)  # by source; the handler's
        self._tasks: set[asyncio.Task[None]] = set()
        self._told: dict[str, _Told] = {}
        self.results: Counter[str] = Counter()
        """Requests by result: ok, or the code of the error."""

    def declare(self, connection: lcm.LCM) -> None:
        """Tell parameters on an open LCM object; listen for requests on ``queries_url``."""
        self._lcm = self._asked = connection
        if self._queries_url != self._url:
            try:
                self._asked = open_lcm(self._queries_url)
            except OutputError as error:
                self._asked = None
                logger.warning("lcm: nobody can ask: %s, that is lcm.queries_url", error)
                return
        for source in self._desks:
            self.serve(source)
        if self._asked is not connection or not self._shared:
            self._thread = threading.Thread(target=self._handle, name="lcm-requests", daemon=True)
            self._thread.start()

    def serve(self, source: str) -> None:
        """Begin to answer for a source whose desk has come."""
        if self._asked is None or source in self._subscriptions:
            return
        channel = lcm_channel(self._prefix, source, "PARAMETERS_REQUEST")
        subscription = self._asked.subscribe(f"^{channel}$", lambda _channel, data: self._take(source, data))
        subscription.set_queue_capacity(MAX_PENDING)
        self._subscriptions[source] = subscription

    def dismiss(self, source: str) -> None:
        """Answer no longer for a source whose desk has gone.

        Its requests find nobody. Its subscription stays: LCM's Python module frees one at once, though
        the handler's thread may be at it.
        """
        self._told.pop(source, None)

    def _handle(self) -> None:
        while not self._closing.is_set() and self._asked is not None:
            try:
                self._asked.handle_timeout(_POLL_MS)
            except OSError as error:
                logger.debug("handling LCM requests: %s", error)
                self._closing.wait(_POLL_MS / 1000)

    def _take(self, source: str, data: bytes) -> None:
        """Check a request in the handler's thread and hand it to the loop."""
        desk = self._desks.get(source)
        if desk is None:
            return
        ignored = self._ignored[source]
        request = _decoded(data)
        if request is None:
            ignored[_MALFORMED] += 1
        elif not self._free.acquire(blocking=False):
            ignored[_BEYOND] += 1
        else:
            with contextlib.suppress(RuntimeError):  # the loop has just ended
                self._loop.call_soon_threadsafe(self._start, desk, request)

    def _start(self, desk: SourceQueries, request: Any) -> None:
        with log_fields(source=desk.source.name):
            task = asyncio.create_task(self._answer(desk, request))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _answer(self, desk: SourceQueries, request: Any) -> None:
        reply = rtc3d.parameters_reply_t()
        reply.request_id, reply.requester = request.request_id, request.requester
        try:
            known = await desk.parameters(_sections(request), fresh=request.fresh, stale_ok=False)
        except QueryError as error:
            reply.error, reply.error_code = str(error), error.code
        except Exception as error:
            logger.exception("%s: LCM request %d of %r", desk.source.name, reply.request_id, reply.requester)
            reply.error, reply.error_code = f"a defect in the gateway: {error!r}", "defect"
        else:
            reply.xml, reply.age_s = _text(known.xml), known.age_s
        finally:
            self._free.release()  # before the reply goes out: who has it may ask again at once
        self.results[reply.error_code or "ok"] += 1
        self._publish(self._asked, desk.source.name, "PARAMETERS_REPLY", reply)

    def tell_parameters(self, source: str, xml: bytes) -> None:
        """Publish a source's parameters, now and again every REPEAT_S seconds."""
        told = self._told.setdefault(source, _Told())
        told.message.xml = _text(xml)
        told.message.capture_utime = now_utime()
        told.message.session = self._desks[source].session
        self._repeat(source, told)

    def maintain(self) -> None:
        """Repeat what is due, and count what was ignored; called once a second."""
        for source, ignored in list(self._ignored.items()):
            for cause in (_MALFORMED, _BEYOND):  # whole counts: the handler's thread goes on counting
                if ignored[cause]:
                    self._drops[source][cause] = ignored[cause]
        for source, told in self._told.items():
            if time.monotonic() >= told.again_at_s:
                self._repeat(source, told)

    def _repeat(self, source: str, told: _Told) -> None:
        told.message.utime = now_utime()
        self._publish(self._lcm, source, "PARAMETERS", told.message)
        told.message.sequence += 1
        told.again_at_s = time.monotonic() + REPEAT_S

    def _publish(self, connection: lcm.LCM | None, source: str, name: str, message: Any) -> None:
        if connection is not None:
            try:
                connection.publish(lcm_channel(self._prefix, source, name), message.encode())
            except OSError as error:
                logger.debug("%s: %s not sent on LCM: %s", source, name, error)

    async def close(self) -> None:
        """Stop listening; requests under way get no reply."""
        self._closing.set()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, _JOIN_S)
        if self._asked is not None:
            for subscription in self._subscriptions.values():
                self._asked.unsubscribe(subscription)
        self._lcm = self._asked = None


def _decoded(data: bytes) -> Any | None:
    """Return a ``parameters_request_t``; None for bytes that are none, or too many."""
    if len(data) > MAX_REQUEST_BYTES:
        return None
    try:
        request = rtc3d.parameters_request_t.decode(data)
    except Exception:  # noqa: BLE001 - lcm-gen's decoders raise whatever comes
        return None
    return request if len(request.requester.encode()) <= MAX_REQUESTER_BYTES else None


def _sections(request: Any) -> tuple[str, ...]:
    """Return the sections asked for, () for all of them; raises QueryError for an unknown one."""
    unknown = set(request.sections) - set(SECTIONS)
    if unknown:
        raise QueryError(unknown_section(min(unknown)))
    asked = tuple(section for section in SECTIONS if section in request.sections)
    return () if asked == tuple(SECTIONS) else asked


def _text(xml: bytes) -> str:
    """Return XML as it came as a text: UTF-8, else Latin-1, without the NULs at its end (field note 9)."""
    body = xml.rstrip(b"\0")
    try:
        return body.decode()
    except UnicodeDecodeError:
        return body.decode("latin-1")
