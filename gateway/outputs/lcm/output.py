"""The LCM output: one channel per topic, and the parameters and requests of each source."""

import asyncio
import functools
import logging
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Final

import lcm

from gateway.errors import OutputError
from gateway.messages.host_time import now_utime
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.contract import Output, OutputHealth, QueryService, ServerParameters, encode_parameters
from gateway.outputs.lcm.replies import LONG_REPLY_BYTES
from gateway.outputs.lcm.requests import LcmRequests
from gateway.outputs.lcm.sender import LcmPublisher, new_sender
from gateway.outputs.lcm.settings import LcmSettings
from gateway.runtime.losses import Losses

logger = logging.getLogger(__name__)

REPEAT_S: Final = 5.0
"""How often the parameters are published again, for late subscribers."""


class _Publication:
    """A source's newest parameters, and when they are due to be published again.

    ``sent`` is the latest publication by the thread.
    """

    def __init__(self) -> None:
        self.parameters: ServerParameters
        self.arrived_utime: int
        self.sequence = 0
        self.due_s = 0.0
        self.sent: Future[None] | None = None


class LcmOutput(Output):
    """Publishes on one LCM URL.

    ``shared`` is an existing LCM object to use, because memq:// connects only users of one object.
    """

    name = "lcm"
    drop_causes = ("not open", "send failed", "closed")

    def __init__(self, settings: LcmSettings, shared: lcm.LCM | None = None) -> None:
        self.settings = settings
        self.max_rate_hz = settings.max_rate_hz
        self.has_tool_poses = settings.tool_poses
        self._shared = shared
        self._channels: set[str] = set()
        self._loop: asyncio.AbstractEventLoop  # from ``serve_queries`` on
        self._requests: LcmRequests | None = None
        self._publications: dict[str, _Publication] = {}  # by source
        self._losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, self.name))  # by source
        self._sender = new_sender(settings.effective_url, shared, self._on_open)

    def _on_open(self) -> None:
        if self._requests is not None and self.settings.queries:
            self._requests.receiver.start()

    def start(self) -> None:
        """Open LCM, with retries."""
        self._sender.open()

    def publisher(self, topic: Topic) -> LcmPublisher:
        """Return a new publisher of ``topic`` on a channel that no other publisher of this output uses."""
        name = lcm_channel(self.settings.prefix, topic.source, *topic.path)
        channel = unique_name(name, self._channels)
        self._channels.add(channel)
        return LcmPublisher(channel, topic.source, self._sender, self._channels)

    def health(self) -> OutputHealth:
        """Return whether LCM is open and the last message was sent."""
        return OutputHealth(not self._sender.problem, self._sender.problem)

    def warnings(self) -> Sequence[str]:
        """Return which sources other gateways publish, too."""
        return () if self._requests is None else self._requests.presence.others.warnings

    def maintain(self) -> None:
        """Retry to open LCM if it is time, and publish parameters again that are due."""
        self._sender.maintain()
        if self._requests is not None:
            self._requests.maintain()
            for source, publication in self._publications.items():
                if time.monotonic() >= publication.due_s:
                    self._publish_again(source, publication, self._requests)

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same."""
        return isinstance(other, LcmOutput) and self.settings == other.settings.model_copy(
            update={"tool_poses": self.settings.tool_poses}
        )

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost later: at the end, and of requests, parameters and replies."""
        self._losses[source] = losses

    def announce(self, source: str) -> None:
        """Answer requests about ``source``. Its status messages show that it is served."""
        if self._requests is not None:
            self._requests.add(source)

    def withdraw(self, source: str) -> None:
        """Stop publishing its parameters. The service no longer serves requests about it."""
        self._publications.pop(source, None)
        if self._requests is not None:
            self._requests.presence.others.forget(source)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish the XML as ``parameters_t``, now and every REPEAT_S. LCM keeps the order of messages.

        Returns a future that is done when long parameters have been sent; None if these have been.
        """
        if self._requests is None:
            return None
        publication = self._publications.setdefault(source, _Publication())
        publication.parameters, publication.arrived_utime = parameters, now_utime()
        sent = self._publish_again(source, publication, self._requests)
        return None if sent is None else asyncio.wrap_future(sent, loop=self._loop)

    def _publish_again(
        self, source: str, publication: _Publication, requests: LcmRequests
    ) -> Future[None] | None:
        publication.due_s = time.monotonic() + REPEAT_S
        waits = publication.sent is not None and not publication.sent.done()
        is_long = len(publication.parameters.xml) > LONG_REPLY_BYTES
        if not (waits or is_long):
            self._publish_newest(source, publication)
            return None
        # If one waits to be sent, it may have begun with the former parameters.
        publish = functools.partial(self._publish_newest, source, publication)
        publication.sent = requests.replies.long_sender.submit(publish)
        return publication.sent

    def _publish_newest(self, source: str, publication: _Publication) -> None:
        """Publish the parameters, in the event loop or in the thread that sends what is long."""
        parameters = publication.parameters
        message = parameters.message or encode_parameters(
            parameters,
            utime=now_utime(),
            arrived_utime=publication.arrived_utime,
            sequence=publication.sequence,
        )
        publication.sequence += 1
        try:
            self._sender.send(lcm_channel(self.settings.prefix, source, "PARAMETERS"), message, source)
        except OutputError as error:
            self._losses[source].lost(error.cause, str(error), frames=0)

    def serve_queries(self, service: QueryService) -> None:
        """Publish parameters and, with ``lcm.queries``, answer ``parameters_request_t`` for each source."""
        self._loop = asyncio.get_running_loop()
        shared = self._shared if self.settings.queries else None
        self._requests = LcmRequests(self.settings, service, self._loop, self._sender, shared, self._losses)

    async def stop_queries(self) -> None:
        """Stop receiving requests. Pending requests get no reply."""
        if self._requests is not None:
            await self._requests.close()

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """By source, the number of requests by result; None before ``serve_queries``."""
        return None if self._requests is None else self._requests.admission.results

    def close(self) -> None:
        """Release LCM, and count the messages that its peer has not taken."""
        for source, num_messages in self._sender.close().items():
            text = f"{num_messages} messages waited when the output was closed; check the peer of lcm.url"
            self._losses[source].lost("closed", text, messages=num_messages, frames=0)
