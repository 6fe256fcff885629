"""One source for viewers: its channels, and the conversion of its frames for those that are subscribed to."""

import time
from collections.abc import Callable, Mapping, Set
from typing import Final

import numpy as np

from gateway.descriptions.source_frame import unknown_unit_text
from gateway.foxglove_schemas.float_topics import MAX_FIELDS, FloatTopics
from gateway.foxglove_schemas.messages import NUMBERS_PER_ITEM, FoxgloveSource
from gateway.foxglove_schemas.topics import MAX_UTIME, FoxgloveMessage, Topic
from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import lcm_content
from gateway.messages.host_time import now_utime
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.foxglove.connections import Viewer
from gateway.outputs.foxglove.server import Channel, FoxgloveServer, send, send_to
from gateway.rtc3d.components import (
    COMPONENT_HEADER_BYTES,
    ITEM_DTYPES,
    WIRE_ORDER,
    Component,
    ComponentType,
)
from gateway.rtc3d.frames import ComponentLayout, Frame
from gateway.rtc3d.parameters import Parameters

SLOW: Final = "slow client"
UNKNOWN_UNIT: Final = "unknown unit"
TOO_MANY: Final = "too many numbers"
RENAMED: Final = "labels change too often"
NO_TIME: Final = "time out of range"

_RENAMING_S: Final = 1.0
"""How often a topic may get other fields. Each time, all viewers get its schema, which can have 500 kB."""

_POSITIONS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)
_CONTENT_HEADER_BYTES: Final = COMPONENT_HEADER_BYTES - 8  # without size and type


class LiveSource:
    """The channels of one source, from its announcement until ``close``.

    All methods are called in the loop of ``server``. ``on_wanted`` is called whenever viewers subscribe to
    channels of other components than before, with these components.
    """

    def __init__(
        self, name: str, server: FoxgloveServer, on_wanted: Callable[[frozenset[ComponentType]], None]
    ) -> None:
        self.losses: Losses | None = None
        self.field_names: Mapping[str, Mapping[str, str]] = {}
        """See ``Output.topic_names``."""
        self._name = name
        self._server = server
        self._on_wanted = on_wanted
        self._wanted: frozenset[ComponentType] = frozenset()
        self._topics = FloatTopics(name, is_live=True)
        # By the names of the topics.
        self._channels: dict[str, Channel] = {}
        self._components: dict[str, ComponentType | None] = {}
        self._renamed_s: dict[str, float] = {}  # when it got other fields, on the monotonic clock
        self._description: Mapping[str, FoxgloveMessage] = {}
        self._parameters = Parameters()
        self._frame = CoordinateFrame(name)
        self._converter = FoxgloveSource(self._topics, Parameters(), 0, self._frame)
        self._open_channels(self._converter.known_topics)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Use other labels, units or another coordinate frame from now on, and tell the viewers."""
        parsed = parameters.parsed
        before = {topic.name for topic in self._converter.known_topics}
        self._parameters = parsed
        self._frame = parameters.frame
        self._converter = FoxgloveSource(self._topics, parsed, parameters.version, self._frame)
        self.field_names = self._converter.changed_names
        known = self._converter.known_topics
        self._open_channels(known)
        self._close_channels(before - {topic.name for topic in known})
        self._check_wanted()
        found = self._converter.describe(now_utime())
        self._description = {message.topic.name: message for message in found}
        for message in found:
            for viewer in list(self._channels[message.topic.name].subscribers):
                self._send_description(viewer, message)

    def open_for(self, layout: ComponentLayout) -> None:
        """Open the channels of a component that frames have, in case the parameters do not mention it."""
        topics = self._converter.topics(layout.type, layout.num_items)
        self._open_channels({each: layout.type for each in topics if each.name not in self._channels})

    def send_frame(self, frame: Frame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Send the components of a frame to the viewers that subscribe to them."""
        for index, layout in enumerate(frame.layout.components):
            if layout.type not in components:
                continue
            self._check_number(layout, stamp)
            topics = self._converter.topics(layout.type, layout.num_items)
            wanted = [topic for topic in topics if self._has_subscribers(topic, layout.type, stamp)]
            if wanted and self._can_convert(layout.type, stamp):
                self._send_component(frame.component(index), stamp, wanted)

    def close(self) -> None:
        """Withdraw all channels."""
        self._close_channels(set(self._channels))
        self._check_wanted()

    # Channels.

    def _open_channels(self, topics: Mapping[Topic, ComponentType | None]) -> None:
        """Open channels, in place of those of the same names."""
        for topic, component in topics.items():
            channel = self._channels.get(topic.name)
            if channel is None or channel.topic != topic:
                self._open_channel(topic, component)

    def _close_channels(self, names: Set[str]) -> None:
        found = [name for name in self._channels if name in names]
        self._server.close_channels([self._channels.pop(name) for name in found])

    def _open_channel(self, topic: Topic, component: ComponentType | None) -> None:
        before = self._channels.get(topic.name)
        if before is not None:
            self._renamed_s[topic.name] = time.monotonic()
            self._server.close_channels([before])
        self._components[topic.name] = component
        self._channels[topic.name] = self._server.open_channel(
            topic, lambda viewer: self._subscribers_changed(topic.name, viewer)
        )
        if before is not None:
            self._check_wanted()

    def _has_subscribers(self, topic: Topic, component: ComponentType, stamp: Stamp) -> bool:
        """Return whether a topic has subscribers. If it has other fields than before, announce it again."""
        channel = self._channels.get(topic.name)
        if channel is None or channel.topic != topic:
            renamed_s = self._renamed_s.get(topic.name)
            if renamed_s is None or time.monotonic() - renamed_s >= _RENAMING_S:
                self._open_channel(topic, component)
            elif channel is not None and channel.subscribers:
                self._count_loss(RENAMED, f"the labels of {topic.name} change more than once a second", stamp)
            return False
        return bool(channel.subscribers)

    def _subscribers_changed(self, name: str, viewer: Viewer | None) -> None:
        message = self._description.get(name)
        if viewer is not None and message is not None:
            self._send_description(viewer, message)
        self._check_wanted()

    def _check_wanted(self) -> None:
        subscribed = {self._components[name] for name, each in self._channels.items() if each.subscribers}
        wanted = frozenset(each for each in WIRE_ORDER if each in subscribed)
        if wanted != self._wanted:
            self._wanted = wanted
            self._on_wanted(wanted)

    # Messages.

    def _send_description(self, viewer: Viewer, message: FoxgloveMessage) -> None:
        # Now, because viewers show no messages from before they were opened.
        if not send_to(viewer, self._channels[message.topic.name], now_utime(), message.data):
            self._count_loss(SLOW, _slow_text(viewer), None)

    def _can_convert(self, component: ComponentType, stamp: Stamp) -> bool:
        if not 0 <= stamp.capture_utime <= MAX_UTIME:
            self._count_loss(NO_TIME, "the time of capture is before 1970 or after 2106", stamp)
            return False
        if component in _POSITIONS and self._frame.metres_per_unit is None:
            self._count_loss(UNKNOWN_UNIT, unknown_unit_text(self._parameters), stamp)
            return False
        return True

    def _check_number(self, layout: ComponentLayout, stamp: Stamp) -> None:
        if has_too_many_numbers(layout) and self._wanted:
            text = f"a frame has more than {MAX_FIELDS} numbers in {layout.type.key}; they are not published"
            self._count_loss(TOO_MANY, text, stamp)

    def _send_component(self, component: Component, stamp: Stamp, wanted: list[Topic]) -> None:
        dtype = ITEM_DTYPES[component.type]
        items = np.frombuffer(lcm_content(component), dtype, component.num_items, _CONTENT_HEADER_BYTES)
        for message in self._converter.convert(
            component.type, items, stamp.capture_utime, component.timestamp_us, wanted
        ):
            for viewer in send(self._channels[message.topic.name], message.utime, message.data):
                self._count_loss(SLOW, _slow_text(viewer), stamp)

    def _count_loss(self, cause: str, text: str, stamp: Stamp | None) -> None:
        if self.losses is not None:
            self.losses.message_lost(cause, text, stamp)


def has_too_many_numbers(layout: ComponentLayout) -> bool:
    """Return whether a component has too many numbers for a topic with a field for each."""
    return layout.num_items * NUMBERS_PER_ITEM.get(layout.type, 0) > MAX_FIELDS


def _slow_text(viewer: Viewer) -> str:
    return (
        f"the viewer at {viewer.address} does not read fast enough and loses messages; show fewer topics in "
        "it, or use a faster network"
    )
