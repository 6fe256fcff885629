"""An output that tests steer: who listens, and what goes wrong."""

from typing import Any

from gateway.messages.decode import decode
from gateway.messages.topics import Topic
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType


class ToyOutput:
    """Raises ``error`` while there is one; ``listened`` holds the last parts of topics somebody hears."""

    def __init__(self, name: str = "toy", *listened: str) -> None:
        self.name = name
        self.max_rate_hz: dict[ComponentType, float] = {}
        self.flowing: list[bool] = []
        self.listened = set(listened)
        self.error: Exception | None = None
        self.declared: list[Topic] = []
        self.given_up: list[Topic] = []
        self.messages: list[tuple[Topic, bytes]] = []
        self.announced: list[str] = []

    def start(self) -> None: ...

    def publisher(self, topic: Topic) -> "ToyPublisher":
        self.declared.append(topic)
        return ToyPublisher(self, topic)

    def announce(self, source: str) -> None:
        self.announced.append(source)

    def withdraw(self, source: str) -> None:
        self.announced.remove(source)

    def show_flowing(self, _source: str, flowing: bool) -> None:
        self.flowing.append(flowing)

    def maintain(self) -> None: ...

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
        return self._topic.path[-1] in self._output.listened

    def publish(self, message: bytes) -> None:
        if self._output.error is not None:
            raise self._output.error
        self._output.messages.append((self._topic, message))

    def close(self) -> None:
        self._output.declared.remove(self._topic)
        self._output.given_up.append(self._topic)
