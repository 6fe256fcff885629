"""From one source's frames to every output: splice each component once, hand it to all."""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from gateway.messages.splice import (
    MESSAGE_TYPES,
    content_timestamp_us,
    has_lcm_form,
    lcm_content,
    splice_content,
)
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import Output
from gateway.outputs.status import OutputStatus
from gateway.publish.routes import ComponentRoute, OutputRoute
from gateway.publish.tool_poses import ToolPoses
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import ComponentLayout, Frame, Layout
from gateway.rtc3d.parameters import Parameters

_MAX_PLANS: Final = 256

logger = logging.getLogger(__name__)


class _Fan:
    """One component on its way to all outputs."""

    __slots__ = ("component", "frames", "lanes", "newest")

    def __init__(self, component: ComponentType) -> None:
        self.component = component
        self.lanes: list[ComponentRoute] = []
        self.frames = 0
        self.newest: bytes | None = None


class _Plan:
    """What is done with the ``wanted`` components of frames of one layout."""

    def __init__(
        self,
        layout: Layout,
        wanted: frozenset[ComponentType],
        fans: Mapping[ComponentType, _Fan],
        *,
        with_tools: bool,
    ) -> None:
        self.layout, self.wanted = layout, wanted
        parts = [(part.type, index) for index, part in enumerate(layout.parts) if part.type in wanted]
        self.fans = [(fans[kind], index) for kind, index in parts]
        """Of each component that is wanted, with its index in the frame."""
        self.is_canonical = all(has_lcm_form(part, layout.byte_order) for part in layout.parts)
        """Whether the contents go into messages as they come."""
        self.tools = [index for kind, index in parts if with_tools and kind is ComponentType.TOOLS]
        """Which components are tools with messages of their own."""


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
        self._ways: list[OutputRoute] = []
        self._last_ways: dict[str, OutputRoute] = {}  # by the output's name, those given up too
        self._fans = {kind: _Fan(kind) for kind in MESSAGE_TYPES}
        self._plans: dict[tuple[Layout, frozenset[ComponentType]], _Plan] = {}
        self._plan: _Plan | None = None  # of the frame before
        self._num_items: dict[ComponentType, int] = {}
        self.on_layout = on_layout
        self._flowing = False
        self._tools = ToolPoses(source)
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
                way = OutputRoute(self._source, output, self._last_ways.get(output.name))
                if self._flowing:
                    output.show_flowing(self._source, True)
            self._last_ways[output.name] = way
            self._ways.append(way)
        for kind, fan in self._fans.items():
            fan.lanes = [way.lanes[kind] for way in self._ways]
        self._tools.use([way for way in self._ways if way.output.name in tool_outputs])
        self._plans.clear()
        self._plan = None
        for way in before.values():
            way.close()

    def close(self) -> None:
        """Give up all that was declared on the outputs."""
        if self._flowing:
            self.show_flowing(False)
        self.use(())

    @property
    def frames(self) -> dict[ComponentType, int]:
        """How many frames came to be published with each component, left out by an output or not."""
        return {kind: fan.frames for kind, fan in self._fans.items()}

    @property
    def newest(self) -> dict[ComponentType, bytes]:
        """The newest message of each component."""
        return {kind: fan.newest for kind, fan in self._fans.items() if fan.newest is not None}

    @property
    def outputs(self) -> list[tuple[Output, OutputStatus]]:
        """Each output with what it did for this source."""
        return [(way.output, way.status) for way in self._ways]

    def publish(self, frame: Frame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        """Publish the frame's components that are ``wanted``; never raises for an output's sake.

        An output that paces a component leaves frames out; its messages are numbered by themselves.
        """
        # The inner loop of the gateway: attributes instead of dictionaries, and calls only to what sends.
        plan = self._plan_of(frame.layout, wanted)
        for fan, index in plan.fans:
            content = frame.content(index) if plan.is_canonical else lcm_content(frame.component(index))
            fan.frames += 1
            message = b""
            spliced = -1  # the number in it, if any
            for lane in fan.lanes:
                if lane.pacer is not None and not lane.pacer.due(
                    content_timestamp_us(content) if stamp.has_clock else None, stamp.utime
                ):
                    continue
                sequence = lane.sequence
                if spliced != sequence:
                    spliced = sequence
                    message = splice_content(fan.component, content, stamp, sequence)
                lane.sequence = sequence + 1
                try:
                    lane.publish(message)
                except Exception as error:  # noqa: BLE001 - a defect in one output must not stop the others
                    lane.num_failed += 1
                    lane.way.failed(error)
                else:
                    lane.message_bytes += len(message)
                    if lane.way.is_failing:
                        lane.way.sent()
            if spliced >= 0:
                fan.newest = message
        for index in plan.tools:
            self._tools.publish(frame, index, stamp)

    def _plan_of(self, layout: Layout, wanted: frozenset[ComponentType]) -> _Plan:
        """Return what is done with frames of a layout, most often the same as with the frame before."""
        plan = self._plan
        if plan is None or plan.layout is not layout or plan.wanted is not wanted:
            self._plan = plan = self._plans.get((layout, wanted)) or self._new_plan(layout, wanted)
        return plan

    def _new_plan(self, layout: Layout, wanted: frozenset[ComponentType]) -> _Plan:
        """Return what is done with frames of a layout that is new, and tell if counts have changed."""
        for part in layout.parts:
            if part.type in wanted and part.type is not ComponentType.EVENT:
                self._note_count(part)
        if len(self._plans) >= _MAX_PLANS:
            self._plans.clear()
        plan = _Plan(layout, wanted, self._fans, with_tools=self._tools.is_used)
        self._plans[layout, wanted] = plan
        return plan

    def _note_count(self, part: ComponentLayout) -> None:
        before = self._num_items.get(part.type)
        if part.num_items == before:
            return
        self._num_items[part.type] = part.num_items
        self._plans.clear()  # so that the next layout with another count comes here again
        if before is not None:
            logger.info(
                "%s: %s has %d items now, %d before", self._source, part.type.key, part.num_items, before
            )
            self.on_layout()

    def listened(self, components: Collection[ComponentType]) -> bool:
        """Return whether anybody may be listening to one of the components on one of the outputs."""
        return any(lane.publisher.wanted for kind in components for lane in self._fans[kind].lanes)

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
