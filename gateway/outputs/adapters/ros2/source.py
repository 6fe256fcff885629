"""One source on ROS 2: its topics, and the messages that each frame becomes.

It takes frames in the event loop and hands them to the sending thread, which encodes and publishes them.
"""

import functools
import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np
import zenoh

from gateway.errors import OutputError, raise_unless_defect
from gateway.messages.coordinate_frame import NO_ROTATION
from gateway.messages.descriptions.labels import describe
from gateway.messages.descriptions.source_frame import unknown_unit_text
from gateway.messages.encode import Stamp
from gateway.messages.ros2.encode import (
    FLOAT_ARRAY,
    POINT_CLOUD,
    POINT_STAMPED,
    POSE_STAMPED,
    WRENCH_STAMPED,
    AnalogEncoder,
    CloudEncoder,
    RosType,
    StampedEncoder,
    TransformNames,
    pack_point,
    pack_pose,
    pack_wrench,
    ros_stamp,
    tf_message,
)
from gateway.messages.ros2.names import (
    ANALOG,
    MARKERS,
    plate_name,
    pose_topic,
    pressure_topic,
    unique_ros_names,
    wrench_topic,
)
from gateway.messages.ros2.plates import RosPlate, ros_plates, transforms_of
from gateway.outputs.adapters.ros2.stamps import DistinctStamps
from gateway.outputs.adapters.ros2.static_transforms import StaticTransforms
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.confirmation import SentMessages
from gateway.outputs.zenoh.session import SessionHolder
from gateway.rtc3d.components import (
    COMPONENT_HEADER_BYTES,
    ITEM_DTYPES,
    ByteOrder,
    ComponentType,
    Items,
)
from gateway.rtc3d.frames import FrameLayout, RawFrame
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses

MAX_TOOLS: Final = 256
MAX_PLATES: Final = 64
"""How many tools and plates can have topics of their own. The server determines how many there are."""

_NOT_YET: Final = ServerParameters(b"", 0, 0, components=frozenset())
"""Stands for the parameters before the first are there."""

_ITEMS_OFFSET: Final = COMPONENT_HEADER_BYTES - 8
"""Of the items in a component's content, which begins after its size and type."""

_LENGTH_COMPONENTS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)

logger = logging.getLogger(__name__)


class Sender(Protocol):
    """The sending thread, which makes no calls before the output is started."""

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        """Queue a call; return False if it cannot be made."""

    def submit(self, call: Callable[[], None]) -> None:
        """Queue a call that must be made, before those that were offered."""


class _Tool(NamedTuple):
    topic: RosTopic
    names: TransformNames


class _Plate(NamedTuple):
    described: RosPlate
    wrench: RosTopic
    pressure: RosTopic | None  # if its place is known

    @property
    def topics(self) -> list[RosTopic]:
        return [self.wrench] if self.pressure is None else [self.wrench, self.pressure]


class RosSource:
    """A FramePublisher: the sending thread publishes each frame of which somebody receives something.

    ``name`` is the source's name in the configuration, ``base`` the beginning of its topics: /mocap/lab.
    ``tf`` is the topic /tf, which all sources share, and ``static`` has /tf_static. There, frames of tools
    and plates begin with the source's name, so that they differ even if sources have one frame: lab/wand.
    ``sent`` counts what Zenoh has taken.
    """

    def __init__(
        self,
        name: str,
        base: str,
        tf: RosTopic,
        static: StaticTransforms,
        router: SessionHolder,
        sender: Sender,
        sent: SentMessages,
    ) -> None:
        self.name = name
        self.on_wanted_changed: Callable[[], None] = lambda: None
        """Called in any thread."""
        self.losses = Losses(logger, f"{name} to ros2")
        """Where to count what cannot be published."""
        self.topics: tuple[RosTopic, ...] = ()
        """All topics but /tf. Any thread may read it."""
        self.names: Mapping[str, Mapping[str, str]] = {}
        """The parts of topics by component key and label, where they differ. Any thread may read it."""
        self._base = base
        self._tf = tf
        self._static = static
        self._router = router
        self._sender = sender
        self._sent = sent
        self._defects = DefectLog(logger, f"{name} to ros2")
        self._is_closed = False
        self._lock = threading.Lock()  # of ``_wanted``
        self._wanted: frozenset[ComponentType] = frozenset()  # what somebody subscribes to
        # Replaced, not changed, because any thread may read it.
        self._by_component: Mapping[ComponentType, Sequence[RosTopic]] = {ComponentType.TOOLS: (tf,)}
        # In the event loop.
        self._parameters = _NOT_YET
        self._num_items: dict[ComponentType, int] = {}  # for how many the frames have opened topics
        self._refused: Mapping[ComponentType, int] = {}  # frames that found no place in the queue
        # In the sending thread.
        self._skipped: Mapping[ComponentType, int] = {}  # those whose numbers the topics have used up
        self._stamps = DistinctStamps()
        self._node: RosNode | None = None
        self._by_name: dict[str, RosTopic] = {}
        self._former: dict[str, RosTopic] = {}  # those that the newest parameters may need again
        self._encoded: list[tuple[RosTopic, bytes]] = []  # the messages of the frame that is being sent
        self._begin_with(_NOT_YET)

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
            components = {} if self._is_closed else self._by_component
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
        self._sender.offer(self._guarded(self._use, parameters), len(parameters.xml))
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
        self._node = node
        for topic in self._by_name.values():
            topic.declare(node)
        self._use(self._parameters)
        self.update_wanted()

    def undeclare(self) -> None:
        """Remove all topics from ROS."""
        for topic in self._by_name.values():
            topic.undeclare()
        self._static.set_transforms(self.name, ())
        self._by_name = {}
        self._by_component = {}
        self.topics = ()

    def check_subscribers(self) -> None:
        """Check again for subscribers."""
        for topic in self.topics:
            topic.check_subscribers()
        self.update_wanted()

    def _use(self, parameters: ServerParameters) -> None:
        """Open the topics that belong to the parameters, and close others. The same ones change nothing."""
        if parameters is self._described_by:
            return
        self._former, self._by_name = self._by_name, {}
        self._begin_with(parameters)
        parsed = parameters.parsed
        self._open(
            {
                ComponentType.MARKERS: len(parsed.markers.markers) if parsed.markers else 0,
                ComponentType.TOOLS: len(parsed.tools.tools) if parsed.tools else 0,
                ComponentType.ANALOG: len(parsed.analog.channels) if parsed.analog else 0,
                ComponentType.FORCE: len(parsed.force.plates) if parsed.force else 0,
            }
        )
        for topic in self._former.values():
            topic.undeclare()
        self._former = {}
        self._static.set_transforms(self.name, transforms_of([plate.described for plate in self._plates]))

    def _begin_with(self, parameters: ServerParameters) -> None:
        self._described_by = parameters
        self._frame = parameters.frame
        self._stamped = StampedEncoder(self._frame.frame_id)
        self._cloud = CloudEncoder(self._frame.frame_id, 0)
        self._channels = AnalogEncoder(())
        self._markers: RosTopic | None = None
        self._analog: RosTopic | None = None
        self._tools: list[_Tool] = []
        self._plates: list[_Plate] = []
        self.names = {}

    def _open_for(self, counts: Mapping[ComponentType, int], parameters: ServerParameters) -> None:
        """Open the topics of frames with so many items, even if the parameters do not mention them."""
        self._use(parameters)
        self._open(counts)

    def _open(self, counts: Mapping[ComponentType, int]) -> None:
        if counts.get(ComponentType.MARKERS):
            self._markers = self._topic(MARKERS, POINT_CLOUD)
        if counts.get(ComponentType.ANALOG):
            self._analog = self._topic(ANALOG, FLOAT_ARRAY)
        num_tools = min(counts.get(ComponentType.TOOLS, 0), MAX_TOOLS)
        if num_tools > len(self._tools):
            self._open_tools(num_tools)
        num_plates = min(counts.get(ComponentType.FORCE, 0), MAX_PLATES)
        if num_plates > len(self._plates):
            self._open_plates(num_plates)
        self.topics = tuple(self._by_name.values())
        self._by_component = {
            ComponentType.TOOLS: (self._tf, *(tool.topic for tool in self._tools)),
            ComponentType.FORCE: tuple(topic for plate in self._plates for topic in plate.topics),
            ComponentType.MARKERS: () if self._markers is None else (self._markers,),
            ComponentType.ANALOG: () if self._analog is None else (self._analog,),
        }
        self.update_wanted()  # a subscriber may have come before a topic was among them

    def _open_tools(self, num_tools: int) -> None:
        labels = describe(ComponentType.TOOLS, self._described_by.parsed, num_tools).labels
        names = unique_ros_names(labels, "tool")
        for name in names[len(self._tools) :]:
            topic = self._topic(pose_topic(name), POSE_STAMPED)
            transform = TransformNames(self._frame.frame_id, f"{self.name}/{name}")
            self._tools.append(_Tool(topic, transform))
        self._show_names(ComponentType.TOOLS, labels, names)

    def _open_plates(self, num_plates: int) -> None:
        parsed = self._described_by.parsed
        plates = ros_plates(parsed, self._frame, self.name, num_plates)
        names = [*map(plate_name, range(1, num_plates + 1))]
        for name, plate in [*zip(names, plates, strict=False)][len(self._plates) :]:
            wrench = self._topic(wrench_topic(name), WRENCH_STAMPED)
            pressure = None if plate.frame is None else self._topic(pressure_topic(name), POINT_STAMPED)
            self._plates.append(_Plate(plate, wrench, pressure))
        labels = describe(ComponentType.FORCE, parsed, num_plates).labels
        self._show_names(ComponentType.FORCE, labels, names)

    def _show_names(self, component: ComponentType, labels: Sequence[str], names: Sequence[str]) -> None:
        changed = {label: name for label, name in zip(labels, names, strict=True) if name != label}
        self.names = {**self.names, component.key: changed}

    def _topic(self, name: str, ros_type: RosType) -> RosTopic:
        """Return the topic with this name: one that is open already, or a new one."""
        path = f"{self._base}/{name}"
        topic = self._by_name.get(path) or self._former.pop(path, None)
        if topic is None:
            topic = RosTopic(path, ros_type, self.update_wanted)
            if self._node is not None:
                topic.declare(self._node)
        self._by_name[path] = topic
        return topic

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
        self._use(parameters)
        time_stamp = ros_stamp(self._stamps.distinct(stamp.capture_utime, frame.layout, components))
        try:
            self._encode(frame, time_stamp, components)
        finally:
            self._put_encoded()

    def _encode(self, frame: RawFrame, stamp: bytes, components: frozenset[ComponentType]) -> None:
        for index, layout in enumerate(frame.layout.components):
            kind = layout.type
            if kind not in components:
                continue
            if kind in _LENGTH_COMPONENTS and self._frame.metres_per_unit is None:
                self._count_unknown_unit(kind)
            elif kind is ComponentType.TOOLS:
                self._encode_tools(_items(frame, index), stamp)
            elif kind is ComponentType.MARKERS and self._markers is not None and self._markers.wanted:
                self._encode_markers(self._markers, _items(frame, index), stamp)
            elif kind is ComponentType.FORCE:
                self._encode_forces(_items(frame, index), stamp)
            elif kind is ComponentType.ANALOG and self._analog is not None and self._analog.wanted:
                self._encode_analog(self._analog, _items(frame, index))

    def _put_encoded(self) -> None:
        """Publish the messages of a frame one after the other, so that Zenoh sends them together."""
        encoded, self._encoded = self._encoded, []
        now_ns = time.time_ns()
        for topic, message in encoded:
            topic.put(message, now_ns)
            self._sent.count += 1

    def _skip(self, refused: Mapping[ComponentType, int]) -> None:
        """Use up the numbers of the messages of frames that were not sent, by component."""
        skipped, self._skipped = self._skipped, refused
        for kind, count in refused.items():
            for topic in self._by_component.get(kind, ()):
                if topic.wanted:
                    topic.skip(count - skipped.get(kind, 0))

    def _encode_tools(self, items: Items, stamp: bytes) -> None:
        is_tf_wanted = self._tf.wanted
        if not (is_tf_wanted or any(tool.topic.wanted for tool in self._tools)):
            return
        self._count_too_many("tools", len(items), MAX_TOOLS)
        head = self._stamped.head(stamp)
        transforms = []
        poses = self._frame.poses(items[: len(self._tools)])
        for (topic, names), pose in zip(self._tools, poses, strict=False):  # a frame can have fewer tools
            if pose is None:  # out of view
                continue
            content = pack_pose(*pose[:7])
            transforms.append((names, content))
            if topic.wanted:
                self._encoded.append((topic, head + content))
        if is_tf_wanted and transforms:
            self._encoded.append((self._tf, tf_message(stamp, transforms)))

    def _encode_markers(self, topic: RosTopic, items: Items, stamp: bytes) -> None:
        if self._cloud.num_markers != len(items):
            self._cloud = CloudEncoder(self._frame.frame_id, len(items))
        values = items.view(items.dtype["x"]).reshape(-1, 4)
        cloud = self._cloud.encode(stamp, self._frame.points(values[:, :3]), values[:, 3])
        self._encoded.append((topic, cloud))

    def _encode_forces(self, items: Items, stamp: bytes) -> None:
        if not any(topic.wanted for plate in self._plates for topic in plate.topics):
            return
        self._count_too_many("force plates", len(items), MAX_PLATES)
        loads = turned = items[: len(self._plates)].tolist()
        if self._frame.rotation_xyzw != NO_ROTATION:
            turned = self._frame.vectors(np.array(loads).reshape(-1, 3)).reshape(-1, 6).tolist()
        for ((n, nm, frame), topic, pressure), load, (fx, fy, fz, mx, my, mz) in zip(
            self._plates, loads, turned, strict=False
        ):
            if any(map(math.isnan, load)):
                continue
            if topic.wanted:
                stamped = self._stamped if frame is None else frame.stamped
                wrench = pack_wrench(fx * n, fy * n, fz * n, mx * nm, my * nm, mz * nm)
                self._encoded.append((topic, stamped.encode(stamp, wrench)))
            if frame is not None and pressure is not None and pressure.wanted:
                centre = frame.centre_of_pressure(load)
                if centre is not None:  # without contact, there is none
                    self._encoded.append((pressure, self._stamped.encode(stamp, pack_point(*centre))))

    def _encode_analog(self, topic: RosTopic, items: Items) -> None:
        if self._channels.num_channels != len(items):
            labels = describe(ComponentType.ANALOG, self._described_by.parsed, len(items)).labels
            self._channels = AnalogEncoder(labels)
        self._encoded.append((topic, self._channels.encode(items)))

    def _count_unknown_unit(self, kind: ComponentType) -> None:
        num_messages = sum(topic.wanted for topic in self._by_component.get(kind, ()))
        if num_messages:
            text = unknown_unit_text(self._described_by.parsed)
            self.losses.lost("unknown unit", text, messages=num_messages)

    def _count_too_many(self, noun: str, count: int, most: int) -> None:
        if count > most:
            text = f"a frame has {count} {noun}; only the first {most} have topics"
            self.losses.lost(f"too many {noun}", text, messages=count - most)


_BYTE_ORDERS: Final[tuple[ByteOrder, ...]] = ("big", "little")
_DTYPES: Final = {
    byte_order: {kind: dtype.newbyteorder(byte_order) for kind, dtype in ITEM_DTYPES.items()}
    for byte_order in _BYTE_ORDERS
}


def _items(frame: RawFrame, index: int) -> Items:
    """Return the items of a component, unless they are events, shape (items,).

    That takes a fifth of the time of ``frame.component(index).items()``, which copies the content.
    """
    layout = frame.layout
    component = layout.components[index]
    start, _ = layout.content_spans[index]
    dtype = _DTYPES[layout.byte_order][component.type]
    return np.frombuffer(frame.body, dtype, component.num_items, start + _ITEMS_OFFSET)
