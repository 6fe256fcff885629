"""An output as somebody might add one: a module with its settings, the output, and its entry of the registry.

Its "network" is this process: messages go to the subscriptions with the same address. It has every optional
ability, so that tests can check that each of them needs nothing but this module.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from typing import Any, Final

from gateway.config.settings import OutputSettings
from gateway.config.values import Switch
from gateway.errors import OutputError
from gateway.messages.decode import TEXT
from gateway.messages.encode import Stamp
from gateway.messages.topics import Topic
from gateway.outputs.contract import (
    Answer,
    Command,
    Output,
    OutputHealth,
    QueryService,
    ServerFile,
    ServerParameters,
)
from gateway.outputs.kind import DemoSide, OutputKind, Receive, SubscriptionRequest
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.losses import Losses

UNREACHABLE: Final = "unreachable"
"""The address that never opens."""


class ExampleSettings(OutputSettings):
    """How data goes to the example output."""

    address: str = "local"
    """Where to publish."""

    whole_frames: Switch = False
    """Whether whole frames are published instead of single components."""

    tool_poses: Switch = False
    """Whether each tool has a topic of its own."""


class ExampleSubscription:
    """Receives what is published at ``address``, of all sources or of one, in the publisher's thread."""

    def __init__(self, address: str, request: SubscriptionRequest, receive: Receive) -> None:
        self.address = address
        self._request = request
        self._receive = receive
        _subscriptions.append(self)

    def matches(self, source: str, component: str) -> bool:
        """Return whether the subscription includes this component."""
        request = self._request
        return request.source in (None, source) and request.component in (None, component)

    def receive(self, name: str, message: bytes) -> None:
        """Pass a message on."""
        self._receive(name, message)

    def close(self) -> None:
        """Unsubscribe."""
        _subscriptions.remove(self)


_subscriptions: Final[list[ExampleSubscription]] = []


class ExamplePublisher:
    """Publishes one component of a source, or with "frame" its whole frames."""

    def __init__(self, output: "ExampleOutput", source: str, component: str) -> None:
        self._output = output
        self._source = source
        self._component = component
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether somebody is subscribed."""
        return bool(self._matching())

    def _matching(self) -> list[ExampleSubscription]:
        return [
            each
            for each in _subscriptions.copy()
            if each.address == self._output.settings.address and each.matches(self._source, self._component)
        ]

    def publish(self, message: bytes) -> None:
        """Pass a message to every subscription; raises OutputError while the output is not open."""
        if self._is_closed:
            raise OutputError(f"{self._source}/{self._component} is closed", cause="closed")
        if not self._output.is_open:
            raise OutputError(self._output.health().problem, cause="not open")
        for subscription in self._matching():
            subscription.receive(f"{self._source}/{self._component}", message)

    def close(self) -> None:
        """Close the publisher."""
        self._is_closed = True


class ExampleFramePublisher:
    """Publishes the whole frames of a source: the frame's body."""

    def __init__(self, publisher: ExamplePublisher) -> None:
        self._publisher = publisher

    def wants(self, _components: Collection[ComponentType]) -> bool:
        """Return whether somebody is subscribed."""
        return self._publisher.wanted

    def prepare(self, _layout: FrameLayout, _components: frozenset[ComponentType]) -> bool:
        """Publish all frames, whether or not anybody has subscribed."""
        return True

    def publish(self, frame: RawFrame, _stamp: Stamp, _components: frozenset[ComponentType]) -> None:
        """See FramePublisher."""
        self._publisher.publish(frame.body)

    def close(self) -> None:
        """Close the publisher."""
        self._publisher.close()


class ExampleOutput(Output):
    """Publishes in this process, and records what the gateway calls."""

    name = "example"
    drop_causes = ("not open",)

    def __init__(self, settings: ExampleSettings) -> None:
        self.settings = settings
        self.has_tool_poses = settings.tool_poses
        self.is_open = False
        self.topics: list[Topic] = []
        self.announced: set[str] = set()
        self.streaming: set[str] = set()
        self.parameters: list[tuple[str, ServerParameters]] = []
        self.files: list[tuple[str, Mapping[str, Any]]] = []
        self.num_maintained = 0
        self._service: QueryService | None = None
        self._results: defaultdict[str, Counter[str]] = defaultdict(Counter)

    def start(self) -> None:
        """Open, unless the address is UNREACHABLE."""
        self.is_open = self.settings.address != UNREACHABLE

    def publisher(self, topic: Topic) -> ExamplePublisher:
        """Return a new publisher of ``topic``."""
        self.topics.append(topic)
        return ExamplePublisher(self, topic.source, "/".join(topic.path))

    def health(self) -> OutputHealth:
        """Return whether the output is open."""
        if self.is_open:
            return OutputHealth(True)
        problem = f"nothing answers at {self.settings.address}; correct example.address"
        return OutputHealth(False, problem)

    def close(self) -> None:
        """Close the output."""
        self.is_open = False

    def maintain(self) -> None:
        """Count the calls."""
        self.num_maintained += 1

    def is_configured_like(self, other: Output) -> bool:
        """Return whether the settings are the same, but for the poses of tools."""
        poses = {"tool_poses": self.settings.tool_poses}
        return isinstance(other, ExampleOutput) and self.settings == other.settings.model_copy(update=poses)

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count one ignored request for every source."""
        losses.lost(f"request of {source} ignored", "it came too early", frames=0)

    def announce(self, source: str) -> None:
        """Serve ``source``."""
        self.announced.add(source)

    def withdraw(self, source: str) -> None:
        """Serve ``source`` no longer."""
        self.announced.remove(source)

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Record whether frames of ``source`` arrive."""
        (self.streaming.add if is_streaming else self.streaming.discard)(source)

    def frame_publisher(self, source: str) -> ExampleFramePublisher | None:
        """Return a publisher of whole frames if the settings ask for them."""
        if not self.settings.whole_frames:
            return None
        return ExampleFramePublisher(ExamplePublisher(self, source, "frame"))

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Record the parameters."""
        self.parameters.append((source, parameters))

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Record the file."""
        self.files.append((source, file.description))

    def serve_queries(self, service: QueryService) -> None:
        """Answer ``query``."""
        self._service = service

    async def stop_queries(self) -> None:
        """Answer ``query`` no longer."""
        self._service = None

    async def query(self, key: str, **options: str) -> Answer:
        """Do what a peer's query of SOURCE/KEY does; raises QueryError."""
        assert self._service is not None
        source, *path = key.split("/")
        answer = await self._service.answer(source, tuple(path), options)
        self._results[source]["ok"] += 1
        return answer

    @property
    def query_results(self) -> Mapping[str, Mapping[str, int]]:
        """How many queries were answered, by source."""
        return self._results

    @property
    def commands(self) -> Mapping[str, Command]:
        """The command "greet", which takes a name."""
        return {"greet": _greet}


async def _greet(source: str, options: Mapping[str, str]) -> Answer:
    return Answer(f"{source} greets {options['name']}".encode(), TEXT)


def _subscribe(request: SubscriptionRequest, receive: Receive) -> ExampleSubscription:
    return ExampleSubscription(request.address or ExampleSettings().address, request, receive)


def _demo(_use_network: bool) -> DemoSide:
    settings = ExampleSettings(enabled=True, address="demo")

    def subscribe_here(source: str, receive: Receive) -> ExampleSubscription:
        return _subscribe(SubscriptionRequest(source, address=settings.address), receive)

    return DemoSide(settings, ExampleOutput(settings), subscribe_here)


EXAMPLE: Final = OutputKind(
    name=ExampleOutput.name,
    settings=ExampleSettings,
    create=ExampleOutput,
    subscribe=_subscribe,
    demo=_demo,
)
