"""The route from one source to one output: publishers, pacing, counters and failures."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

import rtc3d

from gateway.errors import OutputError, raise_unless_defect
from gateway.messages.encode import MESSAGE_TYPES, Stamp, lcm_type_name, message_timestamp_us, with_sequence
from gateway.messages.history import MessageHistory
from gateway.messages.topics import Topic
from gateway.outputs.contract import WHOLE_FRAME, FramePublisher, Output, OutputStatus
from gateway.outputs.pacing import Pacer
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import RawFrame
from gateway.runtime.losses import Losses

OPENING_S: Final = 2.0
"""How long an output may take to open, before the gateway starts without it, or warns after a reload."""

logger = logging.getLogger(__name__)


class SentCounter:
    """The number of messages of one kind that an output accepted from one source, and their bytes."""

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0


class OutputRoute:
    """Everything that one source publishes on one output.

    ``sequences`` are the next sequence number of each component. ``history`` keeps the messages that the
    route numbers itself. The route continues the counters of ``predecessor``, an earlier route to an output
    of the same name. ``on_wanted_changed`` is called when ``is_idle`` of a topic may have changed.
    """

    def __init__(
        self,
        source: str,
        output: Output,
        sequences: Mapping[ComponentType, int],
        history: MessageHistory,
        predecessor: "OutputRoute | None" = None,
        on_wanted_changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.source = source
        self.output = output
        self.history = history
        self.sent: dict[str, SentCounter] = {} if predecessor is None else predecessor.sent
        """By component key, or by "status", "clock", "6d/tool" or WHOLE_FRAME."""
        self.losses: Losses = (
            Losses(logger, f"{source} to {output.name}") if predecessor is None else predecessor.losses
        )
        frame_publisher = output.frame_publisher(source)
        self.frame_route: FrameRoute | None = None
        """For whole frames. An output that takes them gets no single components."""
        self.components: dict[ComponentType, TopicRoute] = {}
        if frame_publisher is not None:
            self.frame_route = FrameRoute(self, frame_publisher)
        else:
            before = {} if predecessor is None else predecessor.components
            for component, sequence in sequences.items():
                is_event = component is ComponentType.EVENT  # events are never left out
                self.components[component] = TopicRoute(
                    *(self, (component.key,), MESSAGE_TYPES[component], component.key),
                    max_rate_hz=None if is_event else output.max_rate_hz.get(component),
                    sequence=sequence,
                    predecessor=before.get(component),
                )
        self.status_route = TopicRoute(self, ("status",), rtc3d.status_t, "status")
        self.clock_route = TopicRoute(self, ("clock",), rtc3d.clock_t, "clock")
        self.is_selective: bool = output.watch_wanted(source, on_wanted_changed)
        """Whether to publish only what is wanted."""
        output.count_losses(source, self.losses)
        self._opening_until_s = time.monotonic() + OPENING_S
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
            takes_frames=self.frame_route is not None,
        )

    def count_loss(self, error: BaseException, stamp: Stamp | None) -> None:
        """Count a message that the output did not accept, of the frame with ``stamp`` or of none."""
        cause = error.cause if isinstance(error, OutputError) else type(error).__name__
        text = str(error) if isinstance(error, OutputError) else f"{cause}: {error}"
        # A reload replaces an output by one that takes a moment to open. That is no reason for a warning.
        is_opening = cause == "not open" and time.monotonic() < self._opening_until_s
        self.losses.message_lost(cause, text, stamp, level=logging.INFO if is_opening else logging.WARNING)

    def close(self) -> None:
        """Close the publishers and withdraw the source from the output."""
        for route in (*self.components.values(), self.status_route, self.clock_route):
            route.publisher.close()
        if self.frame_route is not None:
            self.frame_route.publisher.close()
        self.losses.close()
        self.output.withdraw(self.source)


class TopicRoute:
    """The route of one topic to one output. Its messages are counted under ``counted_as``.

    With ``max_rate_hz``, it leaves messages out and numbers the others itself, so that only loss is a gap. It
    continues the numbers of ``predecessor`` if that was paced, too. Otherwise it begins with ``sequence``,
    the number of the next message on routes that are not paced: no route ever goes back to smaller numbers.
    """

    def __init__(
        self,
        output_route: OutputRoute,
        path: tuple[str, ...],
        message_type: type[Any],
        counted_as: str,
        max_rate_hz: float | None = None,
        sequence: int = 0,
        predecessor: "TopicRoute | None" = None,
    ) -> None:
        topic = Topic(output_route.source, path, lcm_type_name(message_type))
        self.publisher = output_route.output.publisher(topic)
        self._publish = self.publisher.publish  # saves looking it up for every message
        self._output_route = output_route
        self._sent = output_route.sent.setdefault(counted_as, SentCounter())
        self._pacer = None if max_rate_hz is None else Pacer(max_rate_hz)
        self._sequence = sequence  # of the next message; only used if the route is paced
        self._history = output_route.history
        self.history_key = f"{counted_as} on {output_route.output.name}"
        """Under which the history keeps the messages that this route numbers itself."""
        if predecessor is not None and predecessor._pacer is not None:  # noqa: SLF001 - of the same class
            self._sequence = predecessor._sequence  # noqa: SLF001

    @property
    def is_idle(self) -> bool:
        """Whether to publish nothing now, because the output wants nothing."""
        return self._output_route.is_selective and not self.publisher.wanted

    def send(self, message: bytes, stamp: Stamp | None = None) -> None:
        """Publish and count one message, unless pacing leaves it out.

        Never raises, because outputs must not disturb each other. ``stamp`` is that of the message's frame;
        None if it belongs to no frame.
        """
        if self._pacer is not None and stamp is not None:
            if not _is_due(self._pacer, message, stamp):
                return
            message = self._number(message)
        try:
            self._publish(message)
        except BaseException as error:  # noqa: BLE001 - a defect in one output must not stop the others
            raise_unless_defect(error)
            self._output_route.count_loss(error, stamp)
        else:
            self._sent.messages += 1
            self._sent.bytes += len(message)

    def skip(self, message: bytes, stamp: Stamp) -> bool:
        """Use up the number of a message that is not published. Return False if pacing leaves it out."""
        if self._pacer is not None:
            if not _is_due(self._pacer, message, stamp):
                return False
            self._number(message)
        return True

    def _number(self, message: bytes) -> bytes:
        """Return a message with its number on a paced route, which it uses up and the history keeps.

        If the output does not accept the message, subscribers see the loss.
        """
        message = with_sequence(message, self._sequence)
        self._sequence += 1
        self._history.add(self.history_key, message)
        return message

    @property
    def is_paced(self) -> bool:
        """Whether the route leaves messages out, and numbers the others itself."""
        return self._pacer is not None

    def numbered(self, message: bytes) -> bytes:
        """Return the newest message with the number of the newest one that this route has let through."""
        return message if self._pacer is None else with_sequence(message, self._sequence - 1)


def _is_due(pacer: Pacer, message: bytes, stamp: Stamp) -> bool:
    return pacer.due(message_timestamp_us(message) if stamp.has_clock else None, stamp.utime)


class FrameRoute:
    """The route of whole frames to an output that takes them."""

    def __init__(self, output_route: OutputRoute, publisher: FramePublisher) -> None:
        self.publisher = publisher
        self._output_route = output_route
        self._sent = output_route.sent.setdefault(WHOLE_FRAME, SentCounter())

    def publish(self, frame: RawFrame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        """Publish and count one frame; never raises, because outputs must not disturb each other."""
        try:
            self.publisher.publish(frame, stamp, wanted)
        except BaseException as error:  # noqa: BLE001 - a defect in one output must not stop the others
            raise_unless_defect(error)
            self._output_route.count_loss(error, stamp)
        else:
            self._sent.messages += 1
            self._sent.bytes += len(frame.body)
