"""One output as one source sees it: its publishers, what they sent, and what they could not."""

import logging

from gateway.errors import OutputError
from gateway.log import HOLD_S, FailureLog
from gateway.messages.splice import MESSAGE_TYPES, lcm_type_name
from gateway.messages.topics import Topic
from gateway.outputs.contract import Output, Publisher
from gateway.outputs.status import OutputStatus
from gateway.publish.pacing import Pacer
from gateway.rtc3d.components import ComponentType

logger = logging.getLogger(__name__)


class OutputRoute:
    """One output as one source sees it; with ``before`` it goes on with the numbers of the one replaced."""

    def __init__(self, source: str, output: Output, before: "OutputRoute | None" = None) -> None:
        self.output = output
        self.lanes: dict[ComponentType, ComponentRoute] = {
            kind: ComponentRoute(
                self,
                kind,
                Topic(source, (kind.key,), lcm_type_name(message_type)),
                None if before is None else before.lanes[kind],
            )
            for kind, message_type in MESSAGE_TYPES.items()
        }
        self.status_publisher = output.publisher(Topic(source, ("status",), "rtc3d.status_t"))
        self.clock_publisher = output.publisher(Topic(source, ("clock",), "rtc3d.clock_t"))
        self.is_failing = False
        self._status: OutputStatus = OutputStatus(output.name) if before is None else before.status
        self._failures = FailureLog(logger, f"{source} to {output.name}", HOLD_S)
        self._source = source
        output.announce(source)

    @property
    def status(self) -> OutputStatus:
        """What was sent and what was not, up to now."""
        for kind, lane in self.lanes.items():
            if lane.sequence > lane.num_failed:
                self._status.messages[kind.key] = lane.sequence - lane.num_failed
                self._status.message_bytes[kind.key] = lane.message_bytes
        return self._status

    def close(self) -> None:
        """Give up everything that was declared on the output."""
        for lane in self.lanes.values():
            lane.publisher.close()
        self.status_publisher.close()
        self.clock_publisher.close()
        self.output.withdraw(self._source)

    def send(self, publisher: Publisher, name: str, message: bytes) -> None:
        """Publish and count; what an output raises is its own affair, never the reader's."""
        try:
            publisher.publish(message)
        except Exception as error:  # noqa: BLE001 - a defect in one output must not stop the others
            self.failed(error)
        else:
            self._status.messages[name] += 1
            self._status.message_bytes[name] += len(message)
            if self.is_failing:
                self.sent()

    def drop(self, cause: str) -> None:
        """Count a message that was not sent."""
        self._status.drops[cause] += 1

    def failed(self, error: Exception) -> None:
        """Count and tell a message that the output did not take."""
        cause = error.cause if isinstance(error, OutputError) else type(error).__name__
        self.drop(cause)
        self._failures.failed(str(error) if isinstance(error, OutputError) else f"{cause}: {error}")
        self.is_failing = True

    def sent(self) -> None:
        """Tell, while ``is_failing``, that the output took a message."""
        self._failures.recovered("messages go out")
        self.is_failing = self._failures.failing


class ComponentRoute:
    """One component on its way to one output: paced, and numbered by itself.

    ``sequence`` is of the next message, ``num_failed`` of those before it the output did not take, and
    ``message_bytes`` is the size of the others. The fan-out counts.
    """

    __slots__ = ("message_bytes", "num_failed", "pacer", "publish", "publisher", "sequence", "way")

    def __init__(
        self, way: OutputRoute, component: ComponentType, topic: Topic, before: "ComponentRoute | None"
    ) -> None:
        self.way = way
        self.publisher = way.output.publisher(topic)
        self.publish = self.publisher.publish
        max_rate_hz = way.output.max_rate_hz.get(component)
        # Events are never skipped.
        self.pacer = None if max_rate_hz is None or component is ComponentType.EVENT else Pacer(max_rate_hz)
        self.sequence: int = 0 if before is None else before.sequence
        self.num_failed: int = 0 if before is None else before.num_failed
        self.message_bytes: int = 0 if before is None else before.message_bytes
