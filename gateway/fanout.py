"""From one source's frames to every output: splice each component once, hand it to all."""

import logging
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Final

import rtc3d

from gateway.errors import OutputError
from gateway.log import HOLD_S, FailureLog
from gateway.message import MESSAGE_TYPES, Stamp, metres_per_unit, splice, tool_poses, type_name
from gateway.names import MAX_LABEL_LENGTH, Topic, unique_name
from gateway.outputs.contract import Output, Publisher
from gateway.pacing import Pacer
from gateway.rtc3d.components import Component, ComponentType, Frame
from gateway.rtc3d.parameters import Parameters
from gateway.status import OutputStatus

_MAX_TOOLS: Final = 256
"""How many tools get a key of their own; the count in a frame is the server's word."""

logger = logging.getLogger(__name__)


class _Way:
    """One output as one source sees it; with ``before`` it goes on with the numbers of the one replaced."""

    def __init__(self, source: str, output: Output, before: "_Way | None" = None) -> None:
        self.output = output
        self.status: OutputStatus = OutputStatus(output.name) if before is None else before.status
        self.lanes: dict[ComponentType, _Lane] = {
            kind: _Lane(
                self,
                kind,
                Topic(source, (kind.key,), type_name(message_type)),
                0 if before is None else before.lanes[kind].sequence,
            )
            for kind, message_type in MESSAGE_TYPES.items()
        }
        self.status_publisher = output.publisher(Topic(source, ("status",), "rtc3d.status_t"))
        self.clock_publisher = output.publisher(Topic(source, ("clock",), "rtc3d.clock_t"))
        self._failures = FailureLog(logger, f"{source} to {output.name}", HOLD_S)
        self._source = source
        output.announce(source)

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
        except OutputError as error:
            self._dropped(error.cause, str(error))
        except Exception as error:  # noqa: BLE001 - a defect in one output must not stop the others
            self._dropped(type(error).__name__, f"{type(error).__name__}: {error}")
        else:
            self.status.messages[name] += 1
            self.status.message_bytes[name] += len(message)
            if self._failures.failing:
                self._failures.recovered("messages go out")

    def _dropped(self, cause: str, text: str) -> None:
        self.status.drops[cause] += 1
        self._failures.failed(text)


class _Lane:
    """One component on its way to one output: paced, and numbered by itself."""

    def __init__(self, way: _Way, component: ComponentType, topic: Topic, sequence: int) -> None:
        self.way = way
        self.publisher = way.output.publisher(topic)
        max_rate_hz = way.output.max_rate_hz.get(component)
        # Events are never skipped.
        self.pacer = None if max_rate_hz is None or component is ComponentType.EVENT else Pacer(max_rate_hz)
        self.sequence = sequence


_Sending = list[tuple[_Way, Publisher]]


def _declared(ways: Iterable[_Way], topic: Topic, before: _Sending) -> _Sending:
    """Return a publisher of ``topic`` for each way, new ones and those there were; the others are closed."""
    kept = dict(before)
    sending = [(way, kept.pop(way) if way in kept else way.output.publisher(topic)) for way in ways]
    for publisher in kept.values():
        publisher.close()
    return sending


class FanOut:
    """Publishes what one source sends. ``tool_outputs`` are the names of outputs with a key per tool.

    ``on_layout`` is called when the number of markers, tools, channels or plates changes; it may be set anew.
    """

    def __init__(
        self,
        source: str,
        outputs: Sequence[Output],
        tool_outputs: Collection[str] = (),
        on_layout: Callable[[], None] = lambda: None,
    ) -> None:
        self._ways: list[_Way] = []
        self._last_ways: dict[str, _Way] = {}  # by the output's name, those given up too
        self._lanes: dict[ComponentType, list[_Lane]] = {}
        self.frames = dict.fromkeys(MESSAGE_TYPES, 0)
        """How many frames came to be published with each component, left out by an output or not."""
        self.newest: dict[ComponentType, bytes] = {}
        """The newest message of each component."""
        self._num_items: dict[ComponentType, int] = {}
        self.on_layout = on_layout
        self._flowing = False
        self._tools = _ToolPoses(source)
        self._source = source
        self.use(outputs, tool_outputs)

    def use(self, outputs: Sequence[Output], tool_outputs: Collection[str] = ()) -> None:
        """Publish on these outputs from now on. Those that were used before notice nothing.

        One in place of another of its name goes on with its numbers and counters.
        """
        before = {way.output.name: way for way in self._ways}
        self._ways = []
        for output in outputs:
            way = before.pop(output.name, None)
            if way is None or way.output is not output:
                if way is not None:
                    way.close()
                way = _Way(self._source, output, self._last_ways.get(output.name))
                if self._flowing:
                    output.show_flowing(self._source, True)
            self._last_ways[output.name] = way
            self._ways.append(way)
        self._lanes = {kind: [way.lanes[kind] for way in self._ways] for kind in MESSAGE_TYPES}
        self._tools.use([way for way in self._ways if way.output.name in tool_outputs])
        for way in before.values():
            way.close()

    def close(self) -> None:
        """Give up all that was declared on the outputs."""
        if self._flowing:
            self.show_flowing(False)
        self.use(())

    @property
    def outputs(self) -> list[tuple[Output, OutputStatus]]:
        """Each output with what it did for this source."""
        return [(way.output, way.status) for way in self._ways]

    def publish(self, frame: Frame, stamp: Stamp, wanted: Collection[ComponentType]) -> None:
        """Publish the frame's components that are ``wanted``; never raises for an output's sake.

        An output that paces a component leaves frames out; its messages are numbered by themselves.
        """
        for component in frame.components:
            kind = component.type
            if kind not in wanted:
                continue
            self.frames[kind] += 1
            message = None
            sequence = -1
            for lane in self._lanes[kind]:
                if lane.pacer is not None and not lane.pacer.due(
                    component.timestamp_us if stamp.has_clock else None, stamp.utime
                ):
                    continue
                if message is None or sequence != lane.sequence:
                    sequence = lane.sequence
                    message = splice(component, stamp, sequence)
                lane.sequence += 1
                lane.way.send(lane.publisher, kind.key, message)
            if message is not None:
                self.newest[kind] = message
            if kind is ComponentType.TOOLS:
                self._tools.publish(component, stamp)
            if kind is not ComponentType.EVENT and component.num_items != self._num_items.get(kind):
                self._note_layout(kind, component.num_items)

    def _note_layout(self, kind: ComponentType, num_items: int) -> None:
        before = self._num_items.get(kind)
        self._num_items[kind] = num_items
        if before is not None:
            logger.info("%s: %s has %d items now, %d before", self._source, kind.key, num_items, before)
            self.on_layout()

    def listened(self, components: Collection[ComponentType]) -> bool:
        """Return whether anybody may be listening to one of the components on one of the outputs."""
        return any(lane.publisher.wanted for kind in components for lane in self._lanes[kind])

    def show_flowing(self, flowing: bool) -> None:
        """Show on every output that can whether frames of the source flow."""
        self._flowing = flowing
        for way in self._ways:
            way.output.show_flowing(self._source, flowing)

    def publish_status(self, message: bytes) -> None:
        """Publish an encoded ``status_t``."""
        for way in self._ways:
            way.send(way.status_publisher, "status", message)

    def publish_clock(self, message: bytes) -> None:
        """Publish an encoded ``clock_t``."""
        for way in self._ways:
            way.send(way.clock_publisher, "clock", message)

    def set_parameters(self, parameters: Parameters) -> None:
        """Take the tools' labels (§6.3) and the unit of length (§6.2) for the messages per tool."""
        self._tools.set_parameters(parameters)


class _ToolPoses:
    """The messages per tool: SI poses, on keys that carry the tools' labels."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._ways: list[_Way] = []
        self._labels: tuple[str, ...] = ()
        self._metres: float | None = 1e-3  # None: the server's unit is unknown
        self._tools: list[tuple[str, _Sending]] = []  # name and publishers of each
        self._sequences: dict[str, int] = {}  # by name
        self._too_many = FailureLog(logger, source, HOLD_S)
        self._unit = FailureLog(logger, source)

    def use(self, ways: list[_Way]) -> None:
        self._ways = ways
        self._tools = [(name, _declared(ways, self._topic(name), sending)) for name, sending in self._tools]

    def _topic(self, name: str) -> Topic:
        return Topic(self._source, (ComponentType.TOOLS.key, name), type_name(rtc3d.tool_pose_t))

    def set_parameters(self, parameters: Parameters) -> None:
        labels = () if parameters.tools is None else tuple(tool.label for tool in parameters.tools.tools)
        if labels != self._labels:
            self._labels = labels
            self._close()
        unit = "mm" if parameters.markers is None else parameters.markers.unit
        self._metres = metres_per_unit(unit)
        if self._metres is None and self._ways:
            # A robot that moves by a guessed unit is worse than one that waits.
            text = f"unit of length {unit[:40]!r} is unknown, so no poses per tool"
            self._unit.failed(f"{text}; set it to mm or m in the server")
        elif self._unit.failing:
            self._unit.recovered(f"unit of length {unit!r} is known; poses per tool go out")

    def publish(self, component: Component, stamp: Stamp) -> None:
        if not self._ways:
            return
        if self._metres is None:
            self._drop("unknown unit")
            return
        count = component.num_items
        if count > _MAX_TOOLS:
            self._refuse(count)
            return
        if self._too_many.failing:
            self._too_many.recovered(f"frames of {count} tools; each has a key of its own")
        if count > len(self._tools):
            self._open(count)
        # Fewer than before keep their keys: a count that goes up and down declares nothing anew.
        tools = self._tools[:count]
        if not any(publisher.wanted for _, sending in tools for _, publisher in sending):
            return
        sequences = [self._sequences[name] for name, _ in tools]
        messages = tool_poses(component, stamp, sequences, self._metres)
        for (name, sending), message in zip(tools, messages, strict=True):
            for way, publisher in sending:
                if publisher.wanted:
                    way.send(publisher, "6d/tool", message)
            self._sequences[name] += 1

    def _refuse(self, count: int) -> None:
        self._too_many.failed(f"a frame of {count} tools; none has a key of its own above {_MAX_TOOLS}")
        self._drop("too many tools")

    def _drop(self, cause: str) -> None:
        for way in self._ways:
            way.status.drops[cause] += 1

    def _open(self, count: int) -> None:
        """Declare ``count`` tools; those beyond the parameters are numbered, doubled labels too."""
        self._close()
        # A name that was there before goes on with its numbers.
        before, self._sequences = self._sequences, {}
        for index in range(count):
            label = self._labels[index].strip() if index < len(self._labels) else ""
            name = unique_name(label or f"tool {index + 1}", self._sequences, MAX_LABEL_LENGTH)
            self._sequences[name] = before.get(name, 0)
            self._tools.append((name, _declared(self._ways, self._topic(name), [])))

    def _close(self) -> None:
        for _, sending in self._tools:
            for _, publisher in sending:
                publisher.close()
        self._tools.clear()
