"""The channels of one source, and the messages on them. Everything here is called in the server's thread."""

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from functools import partial
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.source_frame import unknown_unit_text
from gateway.messages.encode import Stamp, lcm_content
from gateway.messages.foxglove.messages import NUMBERS_PER_ITEM, FoxgloveSource
from gateway.messages.foxglove.topics import (
    MAX_FIELDS,
    MAX_UTIME,
    FloatTopics,
    FoxgloveMessage,
    FoxgloveTopic,
)
from gateway.messages.host_time import now_utime
from gateway.outputs.adapters.foxglove.connections import FoxgloveViewer
from gateway.outputs.adapters.foxglove.server import FoxgloveChannel, FoxgloveServer, send
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import COMPONENT_HEADER_BYTES, ITEM_DTYPES, WIRE_ORDER, ComponentType, Items
from gateway.rtc3d.frames import ComponentLayout, RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.losses import Losses

SLOW: Final = "slow client"
UNKNOWN_UNIT: Final = "unknown unit"
TOO_MANY: Final = "too many numbers"
RENAMED: Final = "labels change too often"
NO_TIME: Final = "time out of range"

_RENAMING_S: Final = 1.0
"""How often a topic may get other fields. Each time, all viewers get its schema, which can have 500 kB."""

_MAX_TOGETHER_BYTES: Final = 1024 * 1024
"""How many bytes of frames are converted at once, which takes some times as much memory."""

_POSITIONS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)
_CONTENT_HEADER_BYTES: Final = COMPONENT_HEADER_BYTES - 8  # without size and type


class QueuedFrame(NamedTuple):
    """A frame, and which of its components to send."""

    frame: RawFrame
    stamp: Stamp
    components: frozenset[ComponentType]


class SourceChannels:
    """The channels of one source, from its announcement until ``close``.

    All methods are called in the loop of ``server``. ``on_wanted`` is called whenever viewers subscribe to
    channels of other components than before, with these components.
    """

    def __init__(
        self,
        name: str,
        server: FoxgloveServer,
        losses: Losses,
        on_wanted: Callable[[frozenset[ComponentType]], None],
    ) -> None:
        self.field_names: Mapping[str, Mapping[str, str]] = {}
        """See ``Output.topic_names``."""
        self._name = name
        self._server = server
        self._losses = losses
        self._on_wanted = on_wanted
        self._wanted: frozenset[ComponentType] = frozenset()
        self._topics = FloatTopics(name, is_live=True)
        # By the names of the topics.
        self._channels: dict[str, FoxgloveChannel] = {}
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

    def send_frames(self, frames: Sequence[QueuedFrame]) -> None:
        """Send the components of frames of one layout to the viewers that subscribe to them."""
        layout, components = frames[0].frame.layout, frames[0].components
        num_together = max(1, _MAX_TOGETHER_BYTES // len(frames[0].frame.body))
        for first in range(0, len(frames), num_together):
            for index, component in enumerate(layout.components):
                if component.type in components:
                    self._send_component(frames[first : first + num_together], index)

    def _send_component(self, frames: Sequence[QueuedFrame], index: int) -> None:
        layout = frames[0].frame.layout.components[index]
        if has_too_many_numbers(layout) and self._wanted:
            text = f"a frame has more than {MAX_FIELDS} numbers in {layout.type.key}; they are not published"
            self._count_lost(TOO_MANY, text, frames)
        topics = self._converter.topics(layout.type, layout.num_items)
        wanted = [topic for topic in topics if self._has_subscribers(topic, layout.type, frames)]
        sendable = self._convertible(layout.type, frames) if wanted else ()
        if not sendable:
            return
        unpack = frames[0].frame.layout.unpack_number_and_timestamp
        start, _ = frames[0].frame.layout.content_spans[index]
        lost = []
        for found in self._converter.convert_frames(
            layout.type,
            _stacked_items(sendable, index),
            [queued.stamp.capture_utime for queued in sendable],
            [unpack(queued.frame.body, start)[1] for queued in sendable],
            wanted=wanted,
        ):
            channel = self._channels[found.topic.name]
            for utime, message, frame in zip(found.utimes, found.messages, found.frames, strict=True):
                lost += [(frame, viewer) for viewer in send(channel, utime, message)]
        for frame, viewer in sorted(lost, key=itemgetter(0)):  # as Losses counts the frames
            self._losses.message_lost(SLOW, _slow_text(viewer), sendable[frame].stamp)

    def _count_lost(self, cause: str, text: str, frames: Iterable[QueuedFrame]) -> None:
        for queued in frames:
            self._losses.message_lost(cause, text, queued.stamp)

    def close(self) -> None:
        """Withdraw all channels."""
        self._close_channels(set(self._channels))
        self._check_wanted()

    # Channels.

    def _open_channels(self, topics: Mapping[FoxgloveTopic, ComponentType | None]) -> None:
        """Open channels, in place of those of the same names."""
        for topic, component in topics.items():
            channel = self._channels.get(topic.name)
            if channel is None or channel.topic != topic:
                self._open_channel(topic, component)

    def _close_channels(self, names: Set[str]) -> None:
        found = [name for name in self._channels if name in names]
        self._server.close_channels([self._channels.pop(name) for name in found])

    def _open_channel(self, topic: FoxgloveTopic, component: ComponentType | None) -> None:
        before = self._channels.get(topic.name)
        if before is not None:
            self._renamed_s[topic.name] = time.monotonic()
            self._server.close_channels([before])
        self._components[topic.name] = component
        on_change = partial(self._subscribers_changed, topic.name)
        self._channels[topic.name] = self._server.open_channel(topic, on_change)
        if before is not None:
            self._check_wanted()

    def _has_subscribers(
        self, topic: FoxgloveTopic, component: ComponentType, frames: Sequence[QueuedFrame]
    ) -> bool:
        """Return whether a topic has subscribers. If it has other fields than before, announce it again."""
        channel = self._channels.get(topic.name)
        if channel is None or channel.topic != topic:
            renamed_s = self._renamed_s.get(topic.name)
            if renamed_s is None or time.monotonic() - renamed_s >= _RENAMING_S:
                self._open_channel(topic, component)
            elif channel is not None and channel.subscribers:
                text = f"the labels of {topic.name} change more than once a second"
                self._count_lost(RENAMED, text, frames)
            return False
        return bool(channel.subscribers)

    def _subscribers_changed(self, name: str, viewer: FoxgloveViewer | None) -> None:
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

    def _send_description(self, viewer: FoxgloveViewer, message: FoxgloveMessage) -> None:
        # Now, because viewers show no messages from before they were opened.
        number = self._channels[message.topic.name].subscribers[viewer]
        if not viewer.send_message(number, now_utime(), message.data):
            self._losses.message_lost(SLOW, _slow_text(viewer), None)

    def _convertible(self, component: ComponentType, frames: Sequence[QueuedFrame]) -> Sequence[QueuedFrame]:
        """Return the frames that can be converted; count the others."""
        in_time = [*filter(_is_in_time, frames)]
        if len(in_time) < len(frames):
            text = "the time of capture is before 1970 or after 2106"
            self._count_lost(NO_TIME, text, itertools.filterfalse(_is_in_time, frames))
        if component in _POSITIONS and self._frame.metres_per_unit is None:
            self._count_lost(UNKNOWN_UNIT, unknown_unit_text(self._parameters), in_time)
            return ()
        return in_time


def _is_in_time(queued: QueuedFrame) -> bool:
    return 0 <= queued.stamp.capture_utime <= MAX_UTIME


def _stacked_items(frames: Sequence[QueuedFrame], index: int) -> Items:
    """Return the items of a component of frames of one layout, shape (frames, items)."""
    layout = frames[0].frame.layout
    component = layout.components[index]
    dtype = ITEM_DTYPES[component.type]
    if component.type is ComponentType.EVENT:  # which have two forms, and are few
        contents = [lcm_content(queued.frame.component(index)) for queued in frames]
        data = b"".join([content[_CONTENT_HEADER_BYTES:] for content in contents])
    else:
        start, end = layout.content_spans[index]
        start += _CONTENT_HEADER_BYTES
        data = b"".join([queued.frame.body[start:end] for queued in frames])
        dtype = dtype.newbyteorder(layout.byte_order)
    return np.frombuffer(data, dtype).reshape(len(frames), component.num_items)


def has_too_many_numbers(layout: ComponentLayout) -> bool:
    """Return whether a component has too many numbers for a topic with a field for each."""
    return layout.num_items * NUMBERS_PER_ITEM.get(layout.type, 0) > MAX_FIELDS


def _slow_text(viewer: FoxgloveViewer) -> str:
    return (
        f"the viewer at {viewer.address} does not read fast enough and loses messages; show fewer topics in "
        "it, or use a faster network"
    )
