"""The publisher of the takes output: it queues messages for the thread that writes."""

from collections.abc import Callable
from typing import Any

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.takes.files.writer_thread import WriterThread


class TakesPublisher:
    """Records the messages of one topic in the files that are open; with none, it does nothing.

    ``refusal`` returns the error if the output is not open; ``forget`` is called when the publisher closes.
    """

    def __init__(
        self,
        topic: Topic,
        refusal: Callable[[], OutputError | None],
        full: Callable[[], OutputError],
        forget: Callable[["TakesPublisher"], None],
    ) -> None:
        self.topic = topic
        self._refusal = refusal
        self._full = full
        self._forget = forget
        self._writer: WriterThread | None = None
        self._targets: list[tuple[Any, bytes]] = []  # a Sink and the channel in its files
        self._is_closed = False

    @property
    def wanted(self) -> bool:
        """Whether messages are recorded now."""
        return bool(self._targets)

    def set_targets(self, writer: WriterThread | None, targets: list[tuple[Any, bytes]]) -> None:
        """Record in these sinks, under these channels, from now on."""
        self._writer = writer
        self._targets = targets

    def publish(self, message: bytes) -> None:
        """Queue a message for each file that is open.

        Raises OutputError if the output is not open, or if too many messages wait for the disk.
        """
        writer = self._writer
        if writer is None or not self._targets:
            if self._is_closed:
                name = "/".join((self.topic.source, *self.topic.path))
                raise OutputError(f"takes: {name} is closed; ask for a new publisher", cause="closed")
            refusal = self._refusal()
            if refusal is not None:
                raise refusal
            return
        is_refused = False
        for sink, channel in self._targets:
            if not writer.record(sink, channel, message):
                sink.num_refused += 1
                is_refused = True
        if is_refused:
            raise self._full()

    def close(self) -> None:
        """Stop recording."""
        self._is_closed = True
        self._targets = []
        self._forget(self)
