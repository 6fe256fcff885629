"""Publishing the messages of a take on outputs, as the gateway that recorded them did."""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from gateway.errors import OutputError, ProtocolError
from gateway.messages.decode import decode, message_type
from gateway.messages.encode import CONTENT_OFFSET, lcm_type_name
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, ServerParameters

_PARAMETERS_S: Final = 1.0
"""How long messages wait at most until the outputs have sent the parameters that describe them."""


class Refusal(NamedTuple):
    """What an output did not accept: the key of the messages, the output, and its cause."""

    key: str
    output: str
    cause: str


@dataclass
class ReplayedSource:
    """What was published of one source: its newest parameters, and when; the newest message by key."""

    name: str
    parameters: ServerParameters | None = None
    published_s: float = 0.0
    newest: dict[str, bytes] = field(default_factory=dict)


_Publishers = list[tuple[str, Callable[[bytes], None]]]
"""The publishers of one key, each with the name of its output."""


class Publication:
    """Publishes the messages of a take in one thread; what outputs do not allow there is done in ``loop``.

    ``sources`` gets the sources, by name.
    """

    def __init__(
        self,
        outputs: Sequence[Output],
        sources: dict[str, ReplayedSource],
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self.sources = sources
        self.num_messages: Counter[str] = Counter()
        """How many messages were published, by key without the labels of tools."""
        self.refusals: Counter[Refusal] = Counter()
        """What the outputs did not accept."""
        self.num_unreadable: Counter[str] = Counter()
        """How many messages without a whole prefix, and parameters, could not be read, by source."""
        self.without_parameters: set[str] = set()
        """The sources of which a component came before any parameters."""
        self._outputs = outputs
        self._loop = loop
        self._publishers: dict[tuple[str, str], _Publishers] = {}

    # In the thread that publishes.

    def publish(self, source: str, key: str, message: bytes) -> None:
        """Publish one message. What an output refuses is counted."""
        if key == "parameters":
            self._publish_parameters(source, message)
            return
        if len(message) < CONTENT_OFFSET:
            self.num_unreadable[source] += 1
            return
        publishers = self._publishers.get((source, key))
        if publishers is None:
            publishers = self._open(source, key, message)
        self.sources[source].newest[key] = message
        for output, publish in publishers:
            try:
                publish(message)
            except OutputError as error:
                self.refusals[Refusal(_component(key), output, error.cause)] += 1
        self.num_messages[_component(key)] += 1

    def _open(self, source: str, key: str, message: bytes) -> _Publishers:
        if self._source(source).parameters is None and key not in {"status", "clock"}:
            self.without_parameters.add(source)
        topic = Topic(source, tuple(key.split("/", 1)), lcm_type_name(message_type(message)))
        publishers: _Publishers = [(output.name, output.publisher(topic).publish) for output in self._outputs]
        self._publishers[source, key] = publishers
        return publishers

    def _source(self, name: str) -> ReplayedSource:
        source = self.sources.get(name)
        if source is None:
            source = self.sources[name] = ReplayedSource(name)
            self._in_loop(self._announce(name))
        return source

    def _publish_parameters(self, name: str, message: bytes) -> None:
        try:
            recorded = decode(message)
        except ProtocolError:
            self.num_unreadable[name] += 1
            return
        parameters = ServerParameters(
            recorded.xml.encode(), recorded.session, recorded.parameters_version, message=message
        )
        source = self._source(name)
        before = source.parameters
        source.parameters, source.published_s = parameters, time.monotonic()
        is_new = before is None or before[:3] != parameters[:3]
        self._in_loop(self._send_parameters(name, parameters, wait=is_new))
        self.num_messages["parameters"] += 1

    def _in_loop(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    # In the event loop.

    async def _announce(self, source: str) -> None:
        for output in self._outputs:
            output.announce(source)
            output.show_streaming(source, True)

    async def _send_parameters(self, source: str, parameters: ServerParameters, *, wait: bool) -> None:
        """Publish parameters; if ``wait``, wait until no message can overtake them, as the gateway does."""
        sent = [output.publish_parameters(source, parameters) for output in self._outputs]
        pending = [future for future in sent if future is not None]
        if wait and pending:
            await asyncio.wait(pending, timeout=_PARAMETERS_S)

    def show_streaming(self, is_streaming: bool) -> None:
        """Show peers whether messages come, or the replay pauses."""
        for output in self._outputs:
            for source in list(self.sources):
                output.show_streaming(source, is_streaming)


def _component(key: str) -> str:
    return "6d/tool" if key.startswith("6d/") else key
