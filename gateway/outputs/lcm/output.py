"""The LCM output: one channel per topic."""

import asyncio
import logging
from collections import defaultdict
from collections.abc import Mapping

import lcm

from gateway.logs.losses import Losses
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.contract import Output, OutputHealth, QueryService, ServerParameters
from gateway.outputs.lcm.queries import LcmQueries
from gateway.outputs.lcm.sender import LcmPublisher
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.lcm.thread_sender import new_sender

logger = logging.getLogger(__name__)


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
        self._queries: LcmQueries | None = None
        self._losses: defaultdict[str, Losses] = defaultdict(lambda: Losses(logger, self.name))  # by source
        self._sender = new_sender(settings.effective_url, shared, self._on_open)

    def _on_open(self) -> None:
        if self._queries is not None and self.settings.queries:
            self._queries.start()

    def start(self) -> None:
        """Open LCM, with retries."""
        self._sender.open()

    def publisher(self, topic: Topic) -> LcmPublisher:
        """Return a new publisher of ``topic`` on a channel that no other publisher of this output uses."""
        name = lcm_channel(self.settings.prefix, topic.source, *topic.path)
        channel = unique_name(name, self._channels)
        self._channels.add(channel)
        return LcmPublisher(channel, topic.source, self._sender.send, self._forget)

    def _forget(self, publisher: LcmPublisher) -> None:
        self._channels.discard(publisher.channel)

    def health(self) -> OutputHealth:
        """Return whether LCM is open and the last message was sent."""
        return OutputHealth(not self._sender.problem, self._sender.problem)

    def maintain(self) -> None:
        """Retry to open LCM if it is time, and publish parameters again that are due."""
        self._sender.maintain()
        if self._queries is not None:
            self._queries.maintain()

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same."""
        return isinstance(other, LcmOutput) and self.settings == other.settings.model_copy(
            update={"tool_poses": self.settings.tool_poses}
        )

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what is lost later: at the end, and of requests, parameters and replies."""
        self._losses[source] = losses
        if self._queries is not None:
            self._queries.count_losses(source, losses)

    def announce(self, source: str) -> None:
        """Answer requests about ``source``. Its status messages show that it is served."""
        if self._queries is not None:
            self._queries.add(source)

    def withdraw(self, source: str) -> None:
        """Stop answering requests about ``source``."""
        if self._queries is not None:
            self._queries.remove(source)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Publish the XML as ``parameters_t``, now and every few seconds. LCM keeps the order of messages."""
        return None if self._queries is None else self._queries.publish_parameters(source, parameters)

    def serve_queries(self, service: QueryService) -> None:
        """Publish parameters and, with ``lcm.queries``, answer ``parameters_request_t`` for each source."""
        loop = asyncio.get_running_loop()
        shared = self._shared if self.settings.queries else None
        self._queries = LcmQueries(self.settings, service, loop, self._sender, shared)

    async def stop_queries(self) -> None:
        """Stop receiving requests. Pending requests get no reply."""
        if self._queries is not None:
            await self._queries.close()

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]] | None:
        """By source, the number of requests by result; None before ``serve_queries``."""
        return None if self._queries is None else self._queries.results

    def close(self) -> None:
        """Release LCM, and count the messages that its peer has not taken."""
        for source, num_messages in self._sender.close().items():
            text = f"{num_messages} messages waited when the output was closed; check the peer of lcm.url"
            self._losses[source].lost("closed", text, messages=num_messages, frames=0)
