"""An output that keeps messages in memory, for tests and measurements of the gateway itself."""

from collections import deque

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.status import OutputHealth
from gateway.rtc3d.components import ComponentType


class MemoryPublisher:
    """Appends the messages of one topic to the output's queue."""

    def __init__(self, output: "MemoryOutput", topic: Topic) -> None:
        self._output = output
        self._topic = topic
        self._closed = False

    @property
    def wanted(self) -> bool:
        """Whether the output pretends that somebody listens."""
        return self._output.listened

    def publish(self, message: bytes) -> None:
        """Keep ``message``; raises OutputError while the output is not open, or once closed."""
        if self._closed:
            raise OutputError(f"{self._topic} is closed; ask for a new publisher", cause="closed")
        if not self._output.is_open:
            raise OutputError(self._output.health().problem, cause="not open")
        self._output.messages.append((self._topic, message))

    def close(self) -> None:
        """Give up the topic."""
        self._closed = True


class MemoryOutput:
    """Keeps the newest ``capacity`` messages, oldest out first, as (topic, message) in ``messages``."""

    name = "memory"

    def __init__(self, capacity: int = 100_000) -> None:
        self.max_rate_hz: dict[ComponentType, float] = {}
        self.flowing: set[str] = set()
        self.listened = True
        """Whether somebody listens, as far as publishers tell."""
        self.messages: deque[tuple[Topic, bytes]] = deque(maxlen=capacity)
        self.announced: set[str] = set()
        self.is_open = False

    def start(self) -> None:
        """Open the output."""
        self.is_open = True

    def publisher(self, topic: Topic) -> MemoryPublisher:
        """Return a new publisher of ``topic``."""
        return MemoryPublisher(self, topic)

    def announce(self, source: str) -> None:
        """Note that ``source`` is served."""
        self.announced.add(source)

    def withdraw(self, source: str) -> None:
        """Note that ``source`` is no longer served."""
        self.announced.discard(source)

    def show_flowing(self, source: str, flowing: bool) -> None:
        """Note whether frames of ``source`` flow."""
        if flowing:
            self.flowing.add(source)
        else:
            self.flowing.discard(source)

    def maintain(self) -> None:
        """Nothing needs looking after."""

    def health(self) -> OutputHealth:
        """Return whether the output is open."""
        return OutputHealth(self.is_open, "" if self.is_open else "memory output is not open; start it")

    def close(self) -> None:
        """Close the output; what it kept stays readable."""
        self.is_open = False
