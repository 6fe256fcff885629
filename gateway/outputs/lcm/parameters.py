"""The servers' parameters on LCM: published again and again, and sent in reply to requests."""

import asyncio
import functools
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final

import rtc3d

from gateway.messages.host_time import now_utime
from gateway.messages.parameters_text import xml_text
from gateway.outputs.contract import QueryService, ServerParameters
from gateway.outputs.lcm.requests import LONG_REPLY_BYTES, ReplyContent, RequestKind
from gateway.outputs.parameters_message import encode_parameters
from gateway.outputs.send_thread import SendThread

REPEAT_S: Final = 5.0
"""How often the parameters are published again, for late subscribers."""


class _Publication:
    """A source's newest parameters, and when they are due to be published again.

    ``sent`` is the latest publication by the thread.
    """

    def __init__(self) -> None:
        self.newest: tuple[ServerParameters, int] | None = None  # with the time when they arrived, in µs
        self.sequence = 0
        self.due_s = 0.0
        self.sent: Future[None] | None = None


class LcmParameters:
    """Publishes the parameters of each source with ``publish``, which takes the source and the message.

    ``publish`` raises nothing. ``long_sender`` encodes and sends long parameters.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        publish: Callable[[str, bytes], None],
        long_sender: SendThread,
    ) -> None:
        self._loop = loop
        self._publish = publish
        self._long_sender = long_sender
        self._publications: dict[str, _Publication] = {}  # by source

    def publish(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish a source's parameters, now and every REPEAT_S seconds.

        Returns a future that is done when long parameters have been sent; None if these have been.
        """
        publication = self._publications.setdefault(source, _Publication())
        publication.newest = parameters, now_utime()
        sent = self._publish_again(source, publication)
        return None if sent is None else asyncio.wrap_future(sent, loop=self._loop)

    def remove(self, source: str) -> None:
        """Stop publishing a source's parameters."""
        self._publications.pop(source, None)

    def maintain(self) -> None:
        """Publish the parameters again that are due. Called once a second."""
        for source, publication in self._publications.items():
            if time.monotonic() >= publication.due_s:
                self._publish_again(source, publication)

    def _publish_again(self, source: str, publication: _Publication) -> Future[None] | None:
        publication.due_s = time.monotonic() + REPEAT_S
        waits = publication.sent is not None and not publication.sent.done()
        is_long = publication.newest is not None and len(publication.newest[0].xml) > LONG_REPLY_BYTES
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
        parameters, arrived_utime = publication.newest
        message = parameters.message or encode_parameters(
            parameters, utime=now_utime(), arrived_utime=arrived_utime, sequence=publication.sequence
        )
        publication.sequence += 1
        self._publish(source, message)


def parameter_requests(service: QueryService) -> RequestKind:
    """Return the requests for parameters, which ``service`` answers."""

    async def answer(source: str, request: Any) -> ReplyContent:
        parameters = await service.parameters(source, request.sections, fresh=request.fresh)

        def fill(reply: Any) -> None:
            reply.xml, reply.age_s = xml_text(parameters.xml), parameters.age_s
            reply.parameters_version = parameters.version

        return ReplyContent(len(parameters.xml), fill)

    return RequestKind("PARAMETERS", rtc3d.parameters_request_t, rtc3d.parameters_reply_t, answer)
