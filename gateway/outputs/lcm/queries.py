"""What the LCM output does besides its data: it answers requests of peers, and publishes parameters."""

import asyncio
from collections.abc import Mapping

import lcm

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.topics import lcm_channel
from gateway.outputs.contract import QueryService, ServerParameters
from gateway.outputs.lcm.commands import LcmCommands
from gateway.outputs.lcm.parameters import LcmParameters, parameter_requests
from gateway.outputs.lcm.receiver import LcmReceiver
from gateway.outputs.lcm.requests import MAX_PENDING, LcmRequests
from gateway.outputs.lcm.sender import LcmSender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.thread_sender import LcmThreadSender, new_sender
from gateway.outputs.send_thread import SendThread
from gateway.worker_thread import WorkerThread


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
        self._long_sender = SendThread("lcm-send-long")
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
        """See Admission."""
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
