"""One source on ROS 2: it takes frames in the event loop and hands them to the sending thread."""

import functools
import logging
import threading
from collections.abc import Callable, Collection, Mapping
from typing import Protocol

import zenoh

from gateway.errors import OutputError
from gateway.logs.failures import DefectLog
from gateway.logs.losses import Losses
from gateway.messages.encode import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.ros2.source_topics import NOT_YET, SourceTopics
from gateway.outputs.ros2.topic import RosNode, RosTopic
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.session import SessionHolder
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, FrameLayout

logger = logging.getLogger(__name__)


class Sender(Protocol):
    """The sending thread, which makes no calls before the output is started."""

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue a call; return False if it cannot be made."""

    def submit(self, call: Callable[[], None]) -> None:
        """Queue a call that must be made, before those that were offered."""


class RosSource:
    """A FramePublisher: ``send`` of its topics runs in the sending thread, for each frame that is wanted.

    Everything else runs in the event loop. ``name`` is the source's name in the configuration, ``base`` the
    beginning of its topics.
    """

    def __init__(self, name: str, base: str, tf: RosTopic, router: SessionHolder, sender: Sender) -> None:
        self.name = name
        self.on_wanted_changed: Callable[[], None] = lambda: None
        """Called in any thread."""
        self.topics = SourceTopics(name, base, tf, self.update_wanted)
        self.topics.losses = Losses(logger, f"{name} to ros2")
        self._lock = threading.Lock()  # of ``_wanted``
        self._wanted: frozenset[ComponentType] = frozenset()  # what somebody subscribes to
        self._router = router
        self._sender = sender
        self._parameters = NOT_YET
        self._num_items: dict[ComponentType, int] = {}  # for how many the frames have opened topics
        self._refused: Mapping[ComponentType, int] = {}  # frames that found no place in the queue
        self._skipped: Mapping[ComponentType, int] = {}  # those whose numbers the topics have used up
        self._defects = DefectLog(logger, f"{name} to ros2")
        self._is_closed = False

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether somebody subscribes to anything that these components are published on."""
        return not self._wanted.isdisjoint(components)

    @property
    def has_tools(self) -> bool:
        """Whether its streams request tools, whose poses are on /tf, too. Any thread may read it."""
        return ComponentType.TOOLS in self._parameters.components

    def update_wanted(self) -> None:
        """Note that subscribers have come or gone, or topics. In any thread."""
        with self._lock:  # or what one thread has seen could replace what another sees later
            wanted = frozenset() if self._is_closed else self.topics.wanted
            if wanted != self._wanted:
                self._wanted = wanted
                self.on_wanted_changed()

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Open the topics of new parameters. The frames that follow belong to them."""
        self._parameters = parameters
        self._num_items.clear()
        # If the queue is full, the next frame does it.
        self._sender.offer(self._guarded(self.topics.use, parameters), len(parameters.xml))
        self.on_wanted_changed()  # so that the items of the next frames are noted again

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Open the topics of items that the parameters do not mention; return whether frames are wanted."""
        counts = layout.num_items(components)
        more = {each: count for each, count in counts.items() if count > self._num_items.get(each, 0)}
        # If the queue is full, another layout or subscriber does it.
        if more and self._sender.offer(self._guarded(self.topics.open_for, more, self._parameters)):
            self._num_items |= more
        return self.wants(counts)

    def publish(self, frame: Frame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Hand a frame to the sending thread. Raises OutputError if too many wait there."""
        if self._router.is_cut_off or self._is_closed:
            raise self._refusal()
        send = self._guarded(self._send, frame, stamp, components, self._parameters, self._refused)
        if not self._sender.offer(send, len(frame.body)):
            # Replaced, not changed: frames in the queue refer to it.
            self._refused = {**self._refused, **{each: self._refused.get(each, 0) + 1 for each in components}}
            text = "too many frames wait for the Zenoh router; check it and the network to it"
            raise OutputError(text, cause="queue full")

    def _refusal(self) -> OutputError:
        if self._is_closed:
            return OutputError(f"the topics of {self.name} are closed", cause="closed")
        return self._router.refusal

    def _send(
        self,
        frame: Frame,
        stamp: Stamp,
        components: frozenset[ComponentType],
        parameters: ServerParameters,
        refused: Mapping[ComponentType, int],
    ) -> None:
        """Publish a frame; ``refused`` are the frames before it that found no place in the queue."""
        if self._router.is_cut_off:  # since it was queued
            refusal = self._router.refusal
            self.topics.losses.lost(refusal.cause, str(refusal))
            return
        skipped = self._skipped
        if refused is not skipped:
            self.topics.skip({each: count - skipped.get(each, 0) for each, count in refused.items()})
            self._skipped = refused
        self.topics.send(frame, stamp, components, parameters)

    def declare(self, node: RosNode) -> None:
        """Declare all topics on an open session. In the sending thread."""
        self.topics.declare(node)
        self.topics.use(self._parameters)
        self.update_wanted()

    def check_subscribers(self) -> None:
        """Check again for subscribers, in the sending thread."""
        for topic in self.topics.topics:
            topic.check_subscribers()
        self.update_wanted()

    def close(self) -> None:
        """Remove the topics from ROS."""
        self._is_closed = True
        self.update_wanted()
        self._sender.submit(self.topics.undeclare)

    def _guarded(self, call: Callable[..., None], *arguments: object) -> Callable[[], None]:
        return functools.partial(self._call, call, arguments)

    def _call(self, call: Callable[..., None], arguments: tuple[object, ...]) -> None:
        """Make a call in the sending thread, which must not end, whatever the frame has in it."""
        if self._is_closed:
            return
        try:
            call(*arguments)
        except zenoh.ZError as error:
            if not self._router.is_cut_off:  # as it is when the gateway stops
                text = f"Zenoh did not take a message for ROS 2: {zenoh_reason(error)}"
                self.topics.losses.lost("put failed", text)
        except Exception as defect:  # noqa: BLE001 - the other sources continue
            self._defects.log(defect)
            self.topics.losses.lost(type(defect).__name__, f"a frame is not published for ROS 2: {defect}")
