"""The output for viewers: it serves each source in the thread of the server."""

import errno
import logging
import time
from collections.abc import Callable, Collection, Mapping, Set
from functools import partial
from typing import Any, Final

import numpy as np

from gateway.errors import OutputError, PortError, system_reason
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
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.contract import FramePublisher, OutputHealth, ServerParameters
from gateway.outputs.frame_output import LoopThread, PortOpener, ServerOutput, in_this_loop
from gateway.outputs.listen_address import host_in_url
from gateway.rtc3d.components import COMPONENT_HEADER_BYTES, ITEM_DTYPES, WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import ComponentLayout, FrameLayout, RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.failures import DefectLog
from gateway.runtime.losses import Losses

SLOW: Final = "slow client"
QUEUE_FULL: Final = "queue full"
UNKNOWN_UNIT: Final = "unknown unit"
TOO_MANY: Final = "too many numbers"
RENAMED: Final = "labels change too often"
NO_TIME: Final = "time out of range"

_RENAMING_S: Final = 1.0
"""How often a topic may get other fields. Each time, all viewers get its schema, which can have 500 kB."""

_POSITIONS: Final = (ComponentType.MARKERS, ComponentType.TOOLS)
_CONTENT_HEADER_BYTES: Final = COMPONENT_HEADER_BYTES - 8  # without size and type

_BIND_PROBLEMS: Final = {
    errno.EADDRINUSE: "another program uses this port; stop it, or choose another foxglove.port",
    errno.EADDRNOTAVAIL: "this computer does not have this address; correct foxglove.host",
    errno.EACCES: "this port needs the rights of root; choose a foxglove.port from 1024",
}

logger = logging.getLogger(__name__)


class FoxgloveOutput(ServerOutput):
    """Serves viewers on one address, in a thread of its own, which also converts the frames."""

    name = "foxglove"
    drop_causes = (SLOW, QUEUE_FULL)

    def __init__(self, settings: FoxgloveSettings) -> None:
        super().__init__()
        self.settings: FoxgloveSettings = settings
        self._address = f"{host_in_url(settings.host)}:{settings.port}"
        self._opener = PortOpener(logger, self.name, f"not listening on {self._address} yet")
        self._defects = DefectLog(logger, self.name)
        self._server = FoxgloveServer(settings.host, settings.port, str(now_utime()), settings.origins)
        self._sources: dict[str, FoxglovePublisher] = {}

    def _serve(self, thread: LoopThread) -> None:
        thread.run(self._opener.open(self._listen, f"viewers can connect to ws://{self._address}"))

    async def _listen(self) -> None:
        try:
            await self._server.open()
        except OSError as error:
            other = f"{system_reason(error)}; correct foxglove.host and foxglove.port"
            reason = _BIND_PROBLEMS.get(error.errno or 0, other)
            raise PortError(f"cannot listen on {self._address}: {reason}") from error

    def frame_publisher(self, source: str) -> FramePublisher:
        """Return a new publisher of a source."""
        publisher = FoxglovePublisher(source, self._server, self._call, self._offer)
        self._sources[source] = publisher
        return publisher

    def health(self) -> OutputHealth:
        """Return whether viewers can connect."""
        closed = "the server for viewers is closed; start the gateway again" if self._is_closed else ""
        problem = closed or self._opener.problem
        return OutputHealth(not problem, problem)

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what viewers lose."""
        self._sources[source].losses = losses

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """A source is wanted while a viewer subscribes to anything that is in its frames."""
        self._sources[source].watch_wanted(on_change)
        return True

    def announce(self, source: str) -> None:
        """Advertise the channels of ``source``."""
        self._sources[source].open()

    def withdraw(self, source: str) -> None:
        """Withdraw the channels of ``source``."""
        if source in self._sources:
            self._sources.pop(source).close()

    def publish_parameters(self, source: str, parameters: ServerParameters) -> None:
        """Describe the source to viewers, and convert its next frames with these parameters."""
        if source in self._sources:
            self._sources[source].set_parameters(parameters)

    def topic_names(self, source: str) -> Mapping[str, Mapping[str, str]]:
        """Return the names of fields that differ from the labels of channels and plates."""
        return self._sources[source].field_names if source in self._sources else {}

    def close(self) -> None:
        """Disconnect all viewers and release the address."""
        for source in list(self._sources.values()):
            source.close()
        super().close()

    async def _stop(self) -> None:
        await self._server.close()

    def _call(self, call: Callable[[], None]) -> None:
        """Have the thread make a call that must not be left out."""
        if self._thread is None:  # nobody else uses the server yet
            self._defects.attempt(call, None)
        elif not self._offer(call):
            self._thread.run(_make(call))


async def _make(call: Callable[[], None]) -> None:
    call()


class FoxglovePublisher:
    """The FramePublisher of one source: whether viewers want it, and the calls of its SourceChannels.

    ``call`` has the thread make a call. ``call_in_time`` does so if not too many wait, and returns whether it
    does; it takes the call and the number of bytes that it holds.
    """

    def __init__(
        self,
        name: str,
        server: FoxgloveServer,
        call: Callable[[Callable[[], None]], None],
        call_in_time: Callable[[Callable[[], None], int], bool],
    ) -> None:
        self.wanted: frozenset[ComponentType] = frozenset()
        """The components that a viewer has subscribed to."""
        self.losses = Losses(logger, f"{name} to foxglove")
        """Where to count what viewers lose."""
        self._name = name
        self._server = server
        self._call = call
        self._call_in_time = call_in_time
        self._report_wanted: Callable[[frozenset[ComponentType]], None] = lambda _wanted: None
        self._on_change: Callable[[], None] = lambda: None
        self._source: SourceChannels | None = None  # assigned in the thread only
        self._opened: set[ComponentType] = set()  # with numbers, since the newest parameters
        self._is_closed = False

    def watch_wanted(self, on_change: Callable[[], None]) -> None:
        """Call ``on_change`` in this event loop when ``wanted`` has changed."""
        self._on_change = on_change
        self._report_wanted = in_this_loop(self._set_wanted)

    def _set_wanted(self, wanted: frozenset[ComponentType]) -> None:
        if wanted != self.wanted and not self._is_closed:
            self.wanted = wanted
            self._on_change()

    def open(self) -> None:
        """Advertise the channels of the source."""
        self._call(self._open)

    def _open(self) -> None:
        if self._source is None:
            self._source = SourceChannels(self._name, self._server, self.losses, self._report_wanted)

    def _while_open(self, call: Callable[..., None], *arguments: Any) -> None:
        """Make a call of the source, in the thread, if it is open then."""
        if self._source is not None:
            call(self._source, *arguments)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Convert the next frames with these parameters."""
        self._call(partial(self._while_open, SourceChannels.set_parameters, parameters))
        self._opened.clear()
        self._on_change()  # so that frames are looked at again for what the parameters do not mention

    @property
    def field_names(self) -> Mapping[str, Mapping[str, str]]:
        """See ``Output.topic_names``."""
        return {} if self._source is None else self._source.field_names

    def wants(self, components: Collection[ComponentType]) -> bool:
        """Return whether a viewer has subscribed to any of these components."""
        return not self.wanted.isdisjoint(components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        """Open channels for numbers in frames of ``layout``, as far as the parameters do not mention them.

        Return whether a viewer has subscribed to what these frames have. Nobody can subscribe to too many
        numbers. They count as lost while viewers watch the source.
        """
        found = [each for each in layout.components if each.type in components]
        for each in found if not self._is_closed else ():
            is_new = each.type in NUMBERS_PER_ITEM and each.num_items and each.type not in self._opened
            # If the queue is full, another layout or subscriber does it.
            if is_new and self._call_in_time(partial(self._while_open, SourceChannels.open_for, each), 0):
                self._opened.add(each.type)
        is_lost = any(map(has_too_many_numbers, found)) and bool(self.wanted)
        return self.wants([each.type for each in found]) or is_lost

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Hand over a frame; see FramePublisher."""
        if self._is_closed:
            raise OutputError(f"foxglove: {self._name} is closed; ask for a new publisher", cause="closed")
        call = partial(self._while_open, SourceChannels.send_frame, frame, stamp, components)
        if self.wanted and not self._call_in_time(call, len(frame.body)):
            raise OutputError(
                f"foxglove: the frames of {self._name} come faster than they can be converted; show fewer "
                "topics in the viewers",
                cause=QUEUE_FULL,
            )

    def close(self) -> None:
        """Withdraw the channels of the source, and refuse all frames from now on."""
        if not self._is_closed:
            self._is_closed = True
            self.wanted = frozenset()
            self._call(self._close)

    def _close(self) -> None:
        self._while_open(SourceChannels.close)
        self._source = None


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

    def send_frame(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        """Send the components of a frame to the viewers that subscribe to them."""
        for index, layout in enumerate(frame.layout.components):
            if layout.type not in components:
                continue
            if has_too_many_numbers(layout) and self._wanted:
                text = (
                    f"a frame has more than {MAX_FIELDS} numbers in {layout.type.key}; they are not published"
                )
                self._losses.message_lost(TOO_MANY, text, stamp)
            topics = self._converter.topics(layout.type, layout.num_items)
            wanted = [topic for topic in topics if self._has_subscribers(topic, layout.type, stamp)]
            if not wanted or not self._can_convert(layout.type, stamp):
                continue
            component = frame.component(index)
            dtype = ITEM_DTYPES[component.type]
            items = np.frombuffer(lcm_content(component), dtype, component.num_items, _CONTENT_HEADER_BYTES)
            for message in self._converter.convert(
                component.type, items, stamp.capture_utime, component.timestamp_us, wanted
            ):
                for viewer in send(self._channels[message.topic.name], message.utime, message.data):
                    self._losses.message_lost(SLOW, _slow_text(viewer), stamp)

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

    def _has_subscribers(self, topic: FoxgloveTopic, component: ComponentType, stamp: Stamp) -> bool:
        """Return whether a topic has subscribers. If it has other fields than before, announce it again."""
        channel = self._channels.get(topic.name)
        if channel is None or channel.topic != topic:
            renamed_s = self._renamed_s.get(topic.name)
            if renamed_s is None or time.monotonic() - renamed_s >= _RENAMING_S:
                self._open_channel(topic, component)
            elif channel is not None and channel.subscribers:
                self._losses.message_lost(
                    RENAMED, f"the labels of {topic.name} change more than once a second", stamp
                )
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

    def _can_convert(self, component: ComponentType, stamp: Stamp) -> bool:
        if not 0 <= stamp.capture_utime <= MAX_UTIME:
            self._losses.message_lost(NO_TIME, "the time of capture is before 1970 or after 2106", stamp)
            return False
        if component in _POSITIONS and self._frame.metres_per_unit is None:
            self._losses.message_lost(UNKNOWN_UNIT, unknown_unit_text(self._parameters), stamp)
            return False
        return True


def has_too_many_numbers(layout: ComponentLayout) -> bool:
    """Return whether a component has too many numbers for a topic with a field for each."""
    return layout.num_items * NUMBERS_PER_ITEM.get(layout.type, 0) > MAX_FIELDS


def _slow_text(viewer: FoxgloveViewer) -> str:
    return (
        f"the viewer at {viewer.address} does not read fast enough and loses messages; show fewer topics in "
        "it, or use a faster network"
    )
