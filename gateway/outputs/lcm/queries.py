"""What the LCM output does besides its data: it answers requests of peers, and publishes parameters."""

import asyncio
import functools
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final

import lcm
import rtc3d

from gateway.errors import OutputError
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.texts import xml_text
from gateway.messages.topics import lcm_channel
from gateway.outputs.contract import QueryService, ServerParameters
from gateway.outputs.lcm.receiver import LcmReceiver
from gateway.outputs.lcm.requests import (
    LONG_REPLY_BYTES,
    MAX_PENDING,
    LcmCommands,
    LcmRequests,
    ReplyContent,
    RequestKind,
)
from gateway.outputs.lcm.sender import LcmSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.thread_sender import LcmThreadSender, new_sender
from gateway.outputs.parameters_message import encode_parameters
from gateway.workers import WorkerThread

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
        long_sender: WorkerThread,
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
        self._sender = sender
        url = settings.effective_queries_url
        is_own_url = url != settings.effective_url
        self._reply_sender = new_sender(url, None, lambda: None, "replies") if is_own_url else sender
        self._long_sender = WorkerThread("lcm-send-long")
        self._commands = LcmCommands(service)
        kinds = (parameter_requests(service), self._commands.kind)
        self._requests = LcmRequests(
            *(settings, service, loop, kinds, self._reply_sender.send, self._long_sender)
        )
        self._receiver = LcmReceiver(
            *(url, settings.prefix, None if is_own_url else shared, MAX_PENDING, self._open_replies)
        )
        self._parameters = LcmParameters(loop, self._publish_parameters, self._long_sender)

    @property
    def results(self) -> Mapping[str, Mapping[str, int]]:
        """See QueryAdmission."""
        return self._requests.results

    def start(self) -> None:
        """Receive requests. Called in any thread, after the output has opened."""
        self._receiver.start()

    def _open_replies(self) -> None:
        if self._reply_sender is not self._sender:
            self._reply_sender.open()

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost of ``source``: requests, replies and parameters."""
        self._requests.losses[source] = losses

    def add(self, source: str) -> None:
        """Answer requests about one more source."""
        for channel, take in self._requests.channels(source).items():
            self._receiver.add(channel, take)

    def remove(self, source: str) -> None:
        """Stop publishing a source's parameters; ``service`` no longer serves requests about it."""
        self._parameters.remove(source)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish a source's parameters: see LcmParameters."""
        return self._parameters.publish(source, parameters)

    def _publish_parameters(self, source: str, message: bytes) -> None:
        try:
            self._sender.send(lcm_channel(self._prefix, source, "PARAMETERS"), message, source)
        except OutputError as error:
            self._requests.losses[source].lost(error.cause, str(error), frames=0)

    def maintain(self) -> None:
        """Publish the parameters again that are due. Called once a second."""
        if self._reply_sender is not self._sender:
            self._reply_sender.maintain()
        self._parameters.maintain()

    async def close(self) -> None:
        """Stop receiving requests. Pending requests get no reply."""
        await self._receiver.close()
        self._commands.close()
        await self._requests.close()
        self._long_sender.close()
        if self._reply_sender is not self._sender:
            await WorkerThread("close lcm replies").run(self._reply_sender.close)  # may wait for a peer
