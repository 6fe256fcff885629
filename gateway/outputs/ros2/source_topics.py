"""The topics of one source: their names, and the messages that each frame becomes.

The sending thread calls everything here, except where another thread is named.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

from gateway.descriptions.force_plates import units_of
from gateway.descriptions.labels import describe
from gateway.descriptions.source_frame import unknown_unit_text
from gateway.logs.losses import Losses
from gateway.messages.encode import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.ros2 import messages
from gateway.outputs.ros2.messages import (
    FLOAT_ARRAY,
    POINT_CLOUD,
    POSE_STAMPED,
    WRENCH_STAMPED,
    AnalogEncoder,
    CloudEncoder,
    RosType,
    StampedEncoder,
    TransformNames,
    pack_pose,
    pack_wrench,
    tf_message,
)
from gateway.outputs.ros2.settings import unique_ros_names
from gateway.outputs.ros2.topic import RosNode, RosTopic
from gateway.rtc3d.components import Component, ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.parameters import Parameters

MAX_TOOLS: Final = 256
MAX_PLATES: Final = 64
"""How many tools and plates can have topics of their own. The server determines how many there are."""

NOT_YET: Final = ServerParameters(b"", 0, 0, components=frozenset())
"""Stands for the parameters before the first are there."""

_LENGTH_COMPONENTS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)


class _Tool(NamedTuple):
    topic: RosTopic
    names: TransformNames


class _Plate(NamedTuple):
    topic: RosTopic
    newtons: float
    newton_metres: float


class SourceTopics:
    """Publishes the frames of one source. ``base`` is the beginning of its topics: /mocap/lab.

    ``tf`` is the topic /tf, which all sources share. There the frames of tools begin with the source's name,
    so that they differ even if sources have the same frame: lab/wand. ``on_wanted_changed`` is called in any
    thread.
    """

    def __init__(self, source: str, base: str, tf: RosTopic, on_wanted_changed: Callable[[], None]) -> None:
        self.topics: tuple[RosTopic, ...] = ()
        """All topics but /tf. Any thread may read it."""
        self.names: Mapping[str, Mapping[str, str]] = {}
        """The parts of topics by component key and label, where they differ. Any thread may read it."""
        self.losses: Losses
        """Where to count what cannot be published."""
        self._base = base
        self._source = source
        self._tf = tf
        self._on_wanted_changed = on_wanted_changed
        self._node: RosNode | None = None
        self._by_name: dict[str, RosTopic] = {}
        # Replaced, not changed, because any thread may read it.
        self._by_component: Mapping[ComponentType, Sequence[RosTopic]] = {ComponentType.TOOLS: (tf,)}
        self._former: dict[str, RosTopic] = {}  # those that the newest parameters may need again
        self._use(NOT_YET)

    @property
    def wanted(self) -> frozenset[ComponentType]:
        """The components that somebody subscribes to. In any thread."""
        components = self._by_component.items()
        return frozenset(kind for kind, topics in components if any(topic.wanted for topic in topics))

    # Topics.

    def use(self, parameters: ServerParameters) -> None:
        """Open the topics that belong to the parameters, and close others. The same ones change nothing."""
        if parameters is self._parameters:
            return
        self._former, self._by_name = self._by_name, {}
        self._use(parameters)
        self._open(_item_counts(parameters.parsed))
        for topic in self._former.values():
            topic.undeclare()
        self._former = {}

    def _use(self, parameters: ServerParameters) -> None:
        self._parameters = parameters
        self._frame = parameters.frame
        self._stamped = StampedEncoder(self._frame.frame_id)
        self._cloud = CloudEncoder(self._frame.frame_id, 0)
        self._channels = AnalogEncoder(())
        self._markers: RosTopic | None = None
        self._analog: RosTopic | None = None
        self._tools: list[_Tool] = []
        self._plates: list[_Plate] = []
        self.names = {}

    def open_for(self, counts: Mapping[ComponentType, int], parameters: ServerParameters) -> None:
        """Open the topics of frames with so many items, even if the parameters do not mention them."""
        self.use(parameters)
        self._open(counts)

    def _open(self, counts: Mapping[ComponentType, int]) -> None:
        if counts.get(ComponentType.MARKERS):
            self._markers = self._topic("markers", POINT_CLOUD)
        if counts.get(ComponentType.ANALOG):
            self._analog = self._topic("analog", FLOAT_ARRAY)
        num_tools = min(counts.get(ComponentType.TOOLS, 0), MAX_TOOLS)
        if num_tools > len(self._tools):
            self._open_tools(num_tools)
        num_plates = min(counts.get(ComponentType.FORCE, 0), MAX_PLATES)
        if num_plates > len(self._plates):
            self._open_plates(num_plates)
        self.topics = tuple(self._by_name.values())
        self._by_component = {
            ComponentType.TOOLS: (self._tf, *(tool.topic for tool in self._tools)),
            ComponentType.FORCE: tuple(plate.topic for plate in self._plates),
            ComponentType.MARKERS: () if self._markers is None else (self._markers,),
            ComponentType.ANALOG: () if self._analog is None else (self._analog,),
        }
        self._on_wanted_changed()  # a subscriber may have come before a topic was among them

    def _open_tools(self, num_tools: int) -> None:
        labels = describe(ComponentType.TOOLS, self._parameters.parsed, num_tools).labels
        names = unique_ros_names(labels, "tool")
        for name in names[len(self._tools) :]:
            child = f"{self._source}/{name}"
            topic = self._topic(f"{name}/pose", POSE_STAMPED)
            self._tools.append(_Tool(topic, TransformNames(self._frame.frame_id, child)))
        self._show_names(ComponentType.TOOLS, labels, names)

    def _open_plates(self, num_plates: int) -> None:
        force = self._parameters.parsed.force
        plates = force.plates if force else ()
        names = [f"force_{number}" for number in range(1, num_plates + 1)]
        for index in range(len(self._plates), num_plates):
            topic = self._topic(f"{names[index]}/wrench", WRENCH_STAMPED)
            newtons, newton_metres = units_of(plates[index]) if index < len(plates) else (1.0, 1.0)
            self._plates.append(_Plate(topic, newtons, newton_metres))
        labels = describe(ComponentType.FORCE, self._parameters.parsed, num_plates).labels
        self._show_names(ComponentType.FORCE, labels, names)

    def _show_names(self, component: ComponentType, labels: Sequence[str], names: Sequence[str]) -> None:
        changed = {label: name for label, name in zip(labels, names, strict=True) if name != label}
        self.names = {**self.names, component.key: changed}

    def _topic(self, name: str, ros_type: RosType) -> RosTopic:
        """Return the topic with this name: one that is open already, or a new one."""
        path = f"{self._base}/{name}"
        topic = self._by_name.get(path) or self._former.pop(path, None)
        if topic is None:
            topic = RosTopic(path, ros_type, self._on_wanted_changed)
            if self._node is not None:
                topic.declare(self._node)
        self._by_name[path] = topic
        return topic

    def declare(self, node: RosNode) -> None:
        """Declare all topics, now and later, on an open session."""
        self._node = node
        for topic in self._by_name.values():
            topic.declare(node)

    def undeclare(self) -> None:
        """Remove all topics from ROS."""
        for topic in self._by_name.values():
            topic.undeclare()
        self._by_name = {}
        self._by_component = {}
        self.topics = ()

    # Frames.

    def send(
        self,
        frame: Frame,
        stamp: Stamp,
        components: frozenset[ComponentType],
        parameters: ServerParameters,
    ) -> None:
        """Publish the ``components`` of a frame on the topics that have subscribers."""
        self.use(parameters)
        ros_stamp = messages.stamp(stamp.capture_utime)
        now_ns = time.time_ns()
        for index, layout in enumerate(frame.layout.components):
            kind = layout.type
            if kind not in components:
                continue
            if kind in _LENGTH_COMPONENTS and self._frame.metres_per_unit is None:
                self._count_unknown_unit(kind)
            elif kind is ComponentType.TOOLS:
                self._send_tools(frame.component(index), ros_stamp, now_ns)
            elif kind is ComponentType.MARKERS and self._markers is not None and self._markers.wanted:
                self._send_markers(self._markers, frame.component(index), ros_stamp, now_ns)
            elif kind is ComponentType.FORCE:
                self._send_forces(frame.component(index), ros_stamp, now_ns)
            elif kind is ComponentType.ANALOG and self._analog is not None and self._analog.wanted:
                self._send_analog(self._analog, frame.component(index), now_ns)

    def _send_tools(self, component: Component, stamp: bytes, now_ns: int) -> None:
        is_tf_wanted = self._tf.wanted
        if not (is_tf_wanted or any(tool.topic.wanted for tool in self._tools)):
            return
        if component.num_items > MAX_TOOLS:
            self._count_too_many("tools", component.num_items, MAX_TOOLS)
        encode = self._stamped.encode
        transforms = []
        poses = self._frame.poses(component.items()[: len(self._tools)])
        for (topic, names), pose in zip(self._tools, poses, strict=False):  # a frame can have fewer tools
            if pose is None:  # out of view
                continue
            content = pack_pose(*pose[:7])
            transforms.append((names, content))
            if topic.wanted:
                topic.put(encode(stamp, content), now_ns)
        if is_tf_wanted and transforms:
            self._tf.put(tf_message(stamp, transforms), now_ns)

    def _send_markers(self, topic: RosTopic, component: Component, stamp: bytes, now_ns: int) -> None:
        if self._cloud.num_markers != component.num_items:
            self._cloud = CloudEncoder(self._frame.frame_id, component.num_items)
        items = component.items()
        values = items.view(items.dtype["x"]).reshape(-1, 4)
        cloud = self._cloud.encode(stamp, self._frame.points(values[:, :3]), values[:, 3])
        topic.put(cloud, now_ns)

    def _send_forces(self, component: Component, stamp: bytes, now_ns: int) -> None:
        if not any(plate.topic.wanted for plate in self._plates):
            return
        if component.num_items > MAX_PLATES:
            self._count_too_many("force plates", component.num_items, MAX_PLATES)
        items = component.items()[: len(self._plates)]
        vectors = self._frame.vectors(items.view(items.dtype["fx"]).reshape(-1, 3))
        for plate, load in zip(self._plates, vectors.reshape(-1, 6).tolist(), strict=False):
            if plate.topic.wanted and not any(map(math.isnan, load)):
                fx, fy, fz, mx, my, mz = load
                n, nm = plate.newtons, plate.newton_metres
                wrench = pack_wrench(fx * n, fy * n, fz * n, mx * nm, my * nm, mz * nm)
                plate.topic.put(self._stamped.encode(stamp, wrench), now_ns)

    def _send_analog(self, topic: RosTopic, component: Component, now_ns: int) -> None:
        if self._channels.num_channels != component.num_items:
            labels = describe(ComponentType.ANALOG, self._parameters.parsed, component.num_items).labels
            self._channels = AnalogEncoder(labels)
        topic.put(self._channels.encode(component.items()), now_ns)

    # Losses.

    def skip(self, num_frames: Mapping[ComponentType, int]) -> None:
        """Use up the numbers of the messages of frames that were not sent, by component."""
        for kind, count in num_frames.items():
            for topic in self._by_component.get(kind, ()):
                if topic.wanted:
                    topic.skip(count)

    def _count_unknown_unit(self, kind: ComponentType) -> None:
        num_messages = sum(topic.wanted for topic in self._by_component.get(kind, ()))
        if num_messages:
            text = unknown_unit_text(self._parameters.parsed)
            self.losses.lost("unknown unit", text, messages=num_messages)

    def _count_too_many(self, noun: str, count: int, most: int) -> None:
        self.losses.lost(
            f"too many {noun}",
            f"a frame has {count} {noun}; only the first {most} have topics",
            messages=count - most,
        )


def _item_counts(parameters: Parameters) -> dict[ComponentType, int]:
    """Return how many items of each component the parameters list."""
    return {
        ComponentType.MARKERS: len(parameters.markers.markers) if parameters.markers else 0,
        ComponentType.TOOLS: len(parameters.tools.tools) if parameters.tools else 0,
        ComponentType.ANALOG: len(parameters.analog.channels) if parameters.analog else 0,
        ComponentType.FORCE: len(parameters.force.plates) if parameters.force else 0,
    }
