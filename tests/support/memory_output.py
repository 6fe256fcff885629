"""An output that stores messages in memory, for tests and benchmarks."""

from collections import deque

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, OutputHealth


class MemoryPublisher:
    """Appends the messages of one topic to ``MemoryOutput.messages``."""

    def __init__(self, output: "MemoryOutput", topic: Topic) -> None:
        self._output = output
        self._topic = topic
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether the output has a subscriber."""
        return self._output.has_subscriber

    def publish(self, message: bytes) -> None:
        """Store ``message``. Raises OutputError if the publisher is closed or the output is not open."""
        if self._is_closed:
            raise OutputError(f"{self._topic} is closed; ask for a new publisher", cause="closed")
        if not self._output.is_open:
            raise OutputError(self._output.health().problem, cause="not open")
        self._output.messages.append((self._topic, message))

    def close(self) -> None:
        """Close the publisher."""
        self._is_closed = True


class MemoryOutput(Output):
    """Stores the newest ``capacity`` messages, as (topic, message), in ``messages``."""

    name = "memory"

    def __init__(self, capacity: int = 100_000) -> None:
        self.has_subscriber = True
        """Whether publishers report a subscriber."""
        self.messages: deque[tuple[Topic, bytes]] = deque(maxlen=capacity)
        self.announced: set[str] = set()
        self.streaming: set[str] = set()
        self.is_open = False

    def start(self) -> None:
        """Open the output."""
        self.is_open = True

    def publisher(self, topic: Topic) -> MemoryPublisher:
        """Return a new publisher of ``topic``."""
        return MemoryPublisher(self, topic)

    def announce(self, source: str) -> None:
        """Add ``source`` to ``announced``."""
        self.announced.add(source)

    def withdraw(self, source: str) -> None:
        """Remove ``source`` from ``announced``."""
        self.announced.discard(source)

    def show_streaming(self, source: str, is_streaming: bool) -> None:
        """Add ``source`` to ``streaming``, or remove it."""
        if is_streaming:
            self.streaming.add(source)
        else:
            self.streaming.discard(source)

    def health(self) -> OutputHealth:
        """Return whether the output is open."""
        return OutputHealth(self.is_open, "" if self.is_open else "memory output is not open; start it")

    def close(self) -> None:
        """Close the output. The messages stay readable."""
        self.is_open = False
