"""The route from one source to one output: publishers, sequence numbers, counters and failures."""

import logging
from collections import Counter
from typing import Any

import rtc3d

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.encode import MESSAGE_TYPES, content_timestamp_us, encode_content, lcm_type_name
from gateway.messages.stamp import Stamp
from gateway.messages.topics import Topic
from gateway.outputs.contract import FramePublisher, Output
from gateway.outputs.status import OutputStatus
from gateway.publish.pacing import Pacer
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame

logger = logging.getLogger(__name__)


class SentCounter:
    """The number of messages of one kind that an output accepted from one source, and their bytes."""

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0


class OutputRoute:
    """Everything that one source publishes on one output.

    It continues the sequence numbers and counters of ``predecessor``, an earlier route to an output of the
    same name.
    """

    def __init__(self, source: str, output: Output, predecessor: "OutputRoute | None" = None) -> None:
        self.source = source
        self.output = output
        self.sent: dict[str, SentCounter] = {} if predecessor is None else predecessor.sent
        """By component key, or by "status", "clock", "6d/tool" or "frame" (a whole frame)."""
        self.losses: Losses = (
            Losses(logger, f"{source} to {output.name}") if predecessor is None else predecessor.losses
        )
        frame_publisher = output.frame_publisher(source)
        self.frame_route: FrameRoute | None = None
        """For whole frames. An output that takes them gets no single components."""
        if frame_publisher is not None:
            self.frame_route = FrameRoute(
                self, frame_publisher, None if predecessor is None else predecessor.frame_route
            )
        self.components: dict[ComponentType, ComponentRoute] = {
            component: ComponentRoute(
                self, component, None if predecessor is None else predecessor.components.get(component)
            )
            for component in (MESSAGE_TYPES if frame_publisher is None else ())
        }
        self.status_route = TopicRoute(self, ("status",), rtc3d.status_t, "status")
        self.clock_route = TopicRoute(self, ("clock",), rtc3d.clock_t, "clock")
        output.count_losses(source, self.losses)
        output.announce(source)

    @property
    def status(self) -> OutputStatus:
        """The messages sent so far, and what was lost, including what the output counts itself."""
        sent = {name: counter for name, counter in self.sent.items() if counter.messages}
        return OutputStatus(
            self.output.name,
            Counter({name: counter.messages for name, counter in sent.items()}),
            self.losses.report(),
            Counter({name: counter.bytes for name, counter in sent.items()}),
        )

    def count_loss(self, error: Exception, frame: object | None) -> None:
        """Count a message of ``frame`` that the output did not accept; None if it belongs to no frame."""
        cause = error.cause if isinstance(error, OutputError) else type(error).__name__
        text = str(error) if isinstance(error, OutputError) else f"{cause}: {error}"
        self.losses.message_lost(cause, text, frame)

    def close(self) -> None:
        """Close the publishers and withdraw the source from the output."""
        for route in (*self.components.values(), self.status_route, self.clock_route):
            route.close()
        if self.frame_route is not None:
            self.frame_route.close()
        self.losses.close()
        self.output.withdraw(self.source)


class TopicRoute:
    """The route of one topic to one output. Its messages are counted under ``counted_as``."""

    def __init__(
        self, output_route: OutputRoute, path: tuple[str, ...], message_type: type[Any], counted_as: str
    ) -> None:
        topic = Topic(output_route.source, path, lcm_type_name(message_type))
        self.publisher = output_route.output.publisher(topic)
        self._publish = self.publisher.publish  # saves looking it up for every message
        self._output_route = output_route
        self._sent = output_route.sent.setdefault(counted_as, SentCounter())

    def send(self, message: bytes, frame: object | None = None) -> None:
        """Publish and count one message; never raises, because outputs must not disturb each other.

        ``frame`` is any object that all messages of one frame share, None if there is no frame.
        """
        try:
            self._publish(message)
        except Exception as error:  # noqa: BLE001 - a defect in one output must not stop the others
            self._output_route.count_loss(error, frame)
        else:
            self._sent.messages += 1
            self._sent.bytes += len(message)

    def close(self) -> None:
        """Close the publisher."""
        self.publisher.close()


class ComponentRoute(TopicRoute):
    """The route of one component to one output, with pacing and its own sequence numbers."""

    def __init__(
        self, output_route: OutputRoute, component: ComponentType, predecessor: "ComponentRoute | None"
    ) -> None:
        super().__init__(output_route, (component.key,), MESSAGE_TYPES[component], component.key)
        max_rate_hz = output_route.output.max_rate_hz.get(component)
        if component is ComponentType.EVENT:  # events are never left out
            max_rate_hz = None
        self._component = component
        self._pacer = None if max_rate_hz is None else Pacer(max_rate_hz)
        self.sequence: int = 0 if predecessor is None else predecessor.sequence
        """The sequence number of the next message."""

    def publish(self, content: bytes, stamp: Stamp) -> bytes | None:
        """Publish a content in LCM form and return the message; return None if the pacer leaves it out.

        A message that the output does not accept uses up a sequence number, so that subscribers see the loss.
        """
        if self._pacer is not None:
            timestamp_us = content_timestamp_us(content) if stamp.has_clock else None
            if not self._pacer.due(timestamp_us, stamp.utime):
                return None
        message = encode_content(self._component, content, stamp, self.sequence)
        self.sequence += 1
        self.send(message, stamp)
        return message


class FrameRoute:
    """The route of whole frames to an output that takes them, with their own sequence numbers."""

    def __init__(
        self, output_route: OutputRoute, publisher: FramePublisher, predecessor: "FrameRoute | None"
    ) -> None:
        self.publisher = publisher
        self.sequence: int = 0 if predecessor is None else predecessor.sequence
        """The sequence number of the next frame."""
        self._output_route = output_route
        self._sent = output_route.sent.setdefault("frame", SentCounter())

    def publish(self, frame: Frame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        """Publish and count one frame; never raises, because outputs must not disturb each other."""
        sequence = self.sequence
        self.sequence += 1
        try:
            self.publisher.publish(frame, stamp, sequence, wanted)
        except Exception as error:  # noqa: BLE001 - a defect in one output must not stop the others
            self._output_route.count_loss(error, stamp)
        else:
            self._sent.messages += 1
            self._sent.bytes += len(frame.body)

    def close(self) -> None:
        """Close the publisher."""
        self.publisher.close()
