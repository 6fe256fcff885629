"""An output that tests steer: who subscribes, and what goes wrong."""

import asyncio
from typing import Any

from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, OutputHealth, ServerFile, ServerParameters


class ToyOutput(Output):
    """Raises ``error`` while there is one; topics whose last name is in ``wanted`` have a subscriber."""

    drop_causes = ("broken",)

    def __init__(self, name: str = "toy", *wanted: str, has_tool_poses: bool = False) -> None:
        self.name = name
        self.has_tool_poses = has_tool_poses
        self.max_rate_hz = {}
        self.streaming: list[bool] = []
        self.wanted = set(wanted)
        self.error: Exception | None = None
        self.declared: list[Topic] = []
        self.closed_topics: list[Topic] = []
        self.messages: list[tuple[Topic, bytes]] = []
        self.announced: list[str] = []
        self.parameters: list[tuple[str, ServerParameters]] = []
        self.sending: asyncio.Future[None] | None = None
        """Done when parameters have been sent."""
        self.files: list[tuple[str, ServerFile]] = []

    def start(self) -> None: ...

    def publisher(self, topic: Topic) -> "ToyPublisher":
        self.declared.append(topic)
        return ToyPublisher(self, topic)

    def announce(self, source: str) -> None:
        self.announced.append(source)

    def withdraw(self, source: str) -> None:
        self.announced.remove(source)

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        assert source in self.announced
        self.streaming.append(is_streaming)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        self.parameters.append((source, parameters))
        return self.sending

    def announce_file(self, source: str, file: ServerFile) -> None:
        self.files.append((source, file))

    def health(self) -> OutputHealth:
        return OutputHealth(True)

    def close(self) -> None: ...

    def tool_names(self) -> list[str]:
        """Return the names of the tools that have a topic now."""
        return [topic.path[1] for topic in self.declared if len(topic.path) == 2]

    def poses(self, name: str) -> list[Any]:
        """Return the decoded messages of one tool."""
        return [decode(message) for topic, message in self.messages if topic.path == ("6d", name)]


class ToyPublisher:
    def __init__(self, output: ToyOutput, topic: Topic) -> None:
        self._output = output
        self._topic = topic

    @property
    def wanted(self) -> bool:
        return self._topic.path[-1] in self._output.wanted

    def publish(self, message: bytes) -> None:
        if self._output.error is not None:
            raise self._output.error
        self._output.messages.append((self._topic, message))

    def close(self) -> None:
        self._output.declared.remove(self._topic)
        self._output.closed_topics.append(self._topic)
