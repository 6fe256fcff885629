"""One source on ROS 2: it takes frames in the event loop; the sending thread encodes and publishes them."""

import functools
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from typing import Protocol

import zenoh

from gateway.errors import OutputError, raise_unless_defect
from gateway.messages.encode import Stamp
from gateway.messages.ros2.encode import DIAGNOSTIC_ARRAY
from gateway.messages.ros2.names import LABELS
from gateway.outputs.adapters.ros2.latched import LatchedTopic, StaticTransforms
from gateway.outputs.adapters.ros2.settings import Tool
from gateway.outputs.adapters.ros2.source_topics import NO_PARAMETERS, Messages, SourceTopics
from gateway.outputs.adapters.ros2.stamps import DistinctStamps
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.confirmation import SentMessages
from gateway.outputs.zenoh.session import SessionHolder
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses

logger = logging.getLogger(__name__)


class Sender(Protocol):
    """The sending thread, which makes no calls before the output is started."""

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue a call; return False if it cannot be made."""

    def submit(self, call: Callable[[], None]) -> None:
        """Queue a call that must be made, before those that were offered."""


class RosSource:
    """A FramePublisher: the sending thread publishes each frame of which somebody receives something.

    ``name``, ``base``, ``tf``, ``static`` and ``tools`` are those of SourceTopics. ``sent`` counts what Zenoh
    has taken.
    """

    def __init__(
        self,
        name: str,
        base: str,
        tf: RosTopic,
        static: StaticTransforms,
        tools: Mapping[str, Tool],
        router: SessionHolder,
        sender: Sender,
        sent: SentMessages,
    ) -> None:
        self.name = name
        self.on_wanted_changed: Callable[[], None] = lambda: None
        """Called in any thread."""
        self.losses = Losses(logger, f"{name} to ros2")
        """Where to count what cannot be published."""
        self._labels = LatchedTopic(
            f"{base}/{LABELS}", DIAGNOSTIC_ARRAY, lambda: self._sender.submit(self._labels.send)
        )
        self._topics = SourceTopics(
            *(name, base, tf, static, self._labels, tools), self.update_wanted, lambda: self.losses
        )
        self._router = router
        self._sender = sender
        self._sent = sent
        self._defects = DefectLog(logger, f"{name} to ros2")
        self._is_closed = False
        self._lock = threading.Lock()  # of ``_wanted``
        self._wanted: frozenset[ComponentType] = frozenset()  # what somebody subscribes to
        # In the event loop.
        self._parameters = NO_PARAMETERS
        self._num_items: dict[ComponentType, int] = {}  # for how many the frames have opened topics
        self._refused: Mapping[ComponentType, int] = {}  # frames that found no place in the queue
        # In the sending thread.
        self._skipped: Mapping[ComponentType, int] = {}  # those whose numbers the topics have used up
        self._stamps = DistinctStamps()

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether somebody subscribes to anything that these components are published on."""
        return not self._wanted.isdisjoint(components)

    @property
    def topics(self) -> tuple[RosTopic, ...]:
        """All topics but /tf and that of labels. Any thread may read it."""
        return self._topics.all

    @property
    def names(self) -> Mapping[str, Mapping[str, str]]:
        """The parts of topics by component key and label, where they differ. Any thread may read it."""
        return self._topics.names

    @property
    def has_tools(self) -> bool:
        """Whether its streams request tools, whose poses are on /tf, too. Any thread may read it."""
        return ComponentType.TOOLS in self._parameters.components

    def update_wanted(self) -> None:
        """Note that subscribers have come or gone, or topics. In any thread."""
        with self._lock:  # or what one thread has seen could replace what another sees later
            components = {} if self._is_closed else self._topics.by_component
            wanted = frozenset(
                kind for kind, topics in components.items() if any(topic.wanted for topic in topics)
            )
            if wanted != self._wanted:
                self._wanted = wanted
                self.on_wanted_changed()

    # In the event loop.

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Open the topics of new parameters. The frames that follow belong to them."""
        self._parameters = parameters
        self._num_items.clear()
        # If the queue is full, the next frame does it.
        self._sender.offer(self._guarded(self._topics.use, parameters), len(parameters.xml))
        self.on_wanted_changed()  # so that the items of the next frames are noted again

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Open the topics of items that the parameters do not mention; return whether frames are wanted."""
        counts = layout.num_items(components)
        more = {each: count for each, count in counts.items() if count > self._num_items.get(each, 0)}
        # If the queue is full, another layout or subscriber does it.
        if more and self._sender.offer(self._guarded(self._open_for, more, self._parameters)):
            self._num_items |= more
        return self.wants(counts)

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Hand a frame to the sending thread. Raises OutputError if too many wait there."""
        if self._is_closed:
            raise OutputError(f"the topics of {self.name} are closed", cause="closed")
        if self._router.is_cut_off:
            raise self._router.refusal
        send = self._guarded(self._send, frame, stamp, components, self._parameters, self._refused)
        if not self._sender.offer(send, len(frame.body)):
            # Replaced, not changed: frames in the queue refer to it.
            self._refused = {**self._refused, **{each: self._refused.get(each, 0) + 1 for each in components}}
            text = "too many frames wait for the Zenoh router; check it and the network to it"
            raise OutputError(text, cause="queue full")

    def close(self) -> None:
        """Remove the topics from ROS."""
        self._is_closed = True
        self.update_wanted()
        self._sender.submit(self.undeclare)

    def _guarded(self, call: Callable[..., None], *arguments: object) -> Callable[[], None]:
        return functools.partial(self._call, call, arguments)

    # Topics, in the sending thread.

    def _call(self, call: Callable[..., None], arguments: tuple[object, ...]) -> None:
        """Make a call in the sending thread, which must not end, whatever the frame has in it."""
        if self._is_closed:
            return
        try:
            call(*arguments)
        except zenoh.ZError as error:
            if not self._router.is_cut_off:  # as it is when the gateway stops
                text = f"Zenoh did not take a message for ROS 2: {zenoh_reason(error)}"
                self.losses.lost("put failed", text)
        except BaseException as defect:  # noqa: BLE001 - the other sources continue
            raise_unless_defect(defect)
            self._defects.log(defect)
            self.losses.lost(type(defect).__name__, f"a frame is not published for ROS 2: {defect}")

    def declare(self, node: RosNode) -> None:
        """Declare all topics, now and later, on an open session."""
        self._topics.declare(node)
        self._topics.use(self._parameters)
        self.update_wanted()

    def undeclare(self) -> None:
        """Remove all topics from ROS."""
        self._topics.undeclare()

    def check_subscribers(self) -> None:
        """Check again for subscribers."""
        self._topics.check_subscribers()
        self._labels.check_subscribers()
        self.update_wanted()

    def _open_for(self, counts: Mapping[ComponentType, int], parameters: ServerParameters) -> None:
        """Open the topics of frames with so many items, even if the parameters do not mention them."""
        self._topics.use(parameters)
        self._topics.open(counts)

    # Frames, in the sending thread.

    def _send(
        self,
        frame: RawFrame,
        stamp: Stamp,
        components: frozenset[ComponentType],
        parameters: ServerParameters,
        refused: Mapping[ComponentType, int],
    ) -> None:
        """Publish the ``components`` of a frame on the topics that have subscribers.

        ``refused`` are the frames before it that found no place in the queue.
        """
        if self._router.is_cut_off:  # since it was queued
            refusal = self._router.refusal
            self.losses.lost(refusal.cause, str(refusal))
            return
        if refused is not self._skipped:
            self._skip(refused)
        self._topics.use(parameters)
        utime = self._stamps.distinct(stamp.capture_utime, frame.layout, components)
        encoded: Messages = []
        try:
            self._topics.encode(frame, utime, components, encoded)
        finally:
            self._put(encoded)

    def _put(self, encoded: Messages) -> None:
        """Publish the messages of a frame one after the other, so that Zenoh sends them together."""
        now_ns = time.time_ns()
        for topic, message in encoded:
            topic.put(message, now_ns)
            self._sent.count += 1

    def _skip(self, refused: Mapping[ComponentType, int]) -> None:
        """Use up the numbers of the messages of frames that were not sent, by component."""
        skipped, self._skipped = self._skipped, refused
        for kind, count in refused.items():
            for topic in self._topics.by_component.get(kind, ()):
                if topic.wanted:
                    topic.skip(count - skipped.get(kind, 0))
