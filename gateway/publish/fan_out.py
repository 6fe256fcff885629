"""Publishing one source's frames on every output."""

import logging
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from gateway.errors import QueryError
from gateway.messages.encode import MESSAGE_TYPES, ComponentEncoder, Stamp
from gateway.messages.frame_run import MessageNumbers, NumberedLayout
from gateway.messages.history import FoundMessages, MessageHistory, WantedMessages
from gateway.outputs.contract import Output, OutputStatus, ServerParameters
from gateway.publish.routes import FrameRoute, OutputRoute, TopicRoute
from gateway.publish.tool_poses import ToolPoses
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.rtc3d.frames import FrameLayout, RawFrame

_HOLD_S: Final = 30.0
"""After a change was logged, further ones of the same component are logged together after this time."""

logger = logging.getLogger(__name__)


class _Count:
    """The number of items of one component, with the session in which it arrived."""

    def __init__(self, num_items: int, session: int) -> None:
        self.num_items = num_items
        self.session = session
        self.logged_s = float("-inf")  # when a change was last logged
        self.logged_items = num_items  # the number that this log message named
        self.num_changes = 0  # since then


class ItemCounts:
    """Logs each change in a number of items, unless a server changes it again and again."""

    def __init__(self, source: str, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._source = source
        self._monotonic = monotonic
        self._counts: dict[ComponentType, _Count] = {}

    def update(self, num_items: Mapping[ComponentType, int], session: int) -> bool:
        """Take the numbers of one frame; return whether one has changed within the session."""
        is_changed = False
        for component, number in num_items.items():
            count = self._counts.get(component)
            if count is None:
                self._counts[component] = _Count(number, session)
                continue
            if count.num_items != number:
                count.num_items = number
                count.num_changes += 1
                self._log(component, count)
                is_changed = is_changed or session == count.session
            count.session = session
        return is_changed

    def check(self) -> None:
        """Log changes that have not been logged yet, if it is time. Call it every second."""
        for component, count in self._counts.items():
            if count.num_changes:
                self._log(component, count)

    def _log(self, component: ComponentType, count: _Count) -> None:
        now_s = self._monotonic()
        if now_s - count.logged_s < _HOLD_S:
            return
        times = f", after {count.num_changes} changes" if count.num_changes > 1 else ""
        logger.info(
            "%s: number of items in %s changed from %d to %d%s",
            *(self._source, component.key, count.logged_items, count.num_items, times),
        )
        count.logged_s = now_s
        count.logged_items = count.num_items
        count.num_changes = 0


_MAX_PLANS: Final = 64
"""How many plans are cached. The server determines the layouts: each number of events is another one."""


class _Component(MessageNumbers):
    """The numbering of one component's messages, and how the newest frame that has it was published."""

    def __init__(self, component_type: ComponentType) -> None:
        super().__init__(component_type)
        self.plan: _Plan | None = None


class _ComponentPlan:
    """How to publish one component of a layout."""

    def __init__(self, numbers: MessageNumbers, encoder: ComponentEncoder, routes: list[TopicRoute]) -> None:
        self.numbers = numbers
        self.encoder = encoder
        self.routes = routes


@dataclass
class _Plan:
    """How to publish the ``wanted`` components of a layout. Made once per layout, not for every frame."""

    layout: FrameLayout
    wanted: frozenset[ComponentType]
    components: list[_ComponentPlan]
    frame_routes: list[FrameRoute]
    """Those of the outputs that publish such frames now."""
    tool_indices: list[int]
    """The indices of 6D components whose poses are published per tool."""
    num_items: dict[ComponentType, int]
    """The numbers of markers, tools, channels and plates."""
    numbered: NumberedLayout
    newest: tuple[RawFrame, Stamp] | None = None
    """The newest frame that was published, or numbered, in this way."""


class FanOut:
    """Publishes the frames, status and clock of one source on every output.

    It numbers the messages of each component, and the frames, when they arrive. A message that is not
    published afterwards, whatever the reason, leaves a gap in the numbers. All outputs get the same message
    under the same number, except for those with a maximum rate (TopicRoute).

    It calls ``on_items_changed``, which may be assigned later, when the number of markers, tools, channels
    or plates changes within a session. ``forget_layouts`` belongs to the end of a connection.
    """

    def __init__(
        self, source: str, outputs: Sequence[Output], on_items_changed: Callable[[], None] = lambda: None
    ) -> None:
        self.on_items_changed = on_items_changed
        self._source = source
        self._components = {component: _Component(component) for component in MESSAGE_TYPES}
        self._routes: list[OutputRoute] = []
        self._frame_routes: list[FrameRoute] = []
        self._last_routes: dict[str, OutputRoute] = {}  # by the output's name, including closed ones
        self.history = MessageHistory()
        """What was published last, and what was numbered and not published."""
        self._tool_poses = ToolPoses(self.history)
        self._plan_for = lru_cache(_MAX_PLANS)(self._new_plan)
        self._plan: _Plan | None = None  # of the previous frame
        self._item_counts = ItemCounts(source)
        self._is_streaming = False
        self._is_measuring: bool | None = None
        self.set_outputs(outputs)

    def set_outputs(self, outputs: Sequence[Output]) -> None:
        """Publish on these outputs from now on. Routes to outputs that stay are not touched.

        An output that replaces another of the same name continues its counters.
        """
        open_routes = {route.output: route for route in self._routes}
        for output, route in open_routes.items():
            if output not in outputs:
                route.close()
        self._routes = [open_routes.get(output) or self._open_route(output) for output in outputs]
        self._frame_routes = [route.frame_route for route in self._routes if route.frame_route is not None]
        self._tool_poses.set_routes([route for route in self._routes if route.output.has_tool_poses])
        self.forget_layouts()

    def _open_route(self, output: Output) -> OutputRoute:
        route = OutputRoute(
            *(self._source, output, self.frames, self.history),
            predecessor=self._last_routes.get(output.name),
            on_wanted_changed=self.forget_layouts,
        )
        self._last_routes[output.name] = route
        if self._is_streaming:
            output.show_streaming(self._source, True)
        if self._is_measuring is not None:
            output.show_measurement(self._source, self._is_measuring)
        return route

    def close(self) -> None:
        """Close every route, so that no output announces the source any more."""
        if self._is_streaming:
            self.show_streaming(False)
        self.set_outputs(())

    @property
    def frames(self) -> dict[ComponentType, int]:
        """The number of frames with each component that have arrived, published or not."""
        return {component.type: component.next for component in self._components.values()}

    def newest(self, component: ComponentType, output: str) -> bytes | None:
        """Return the message of the newest frame with a component that has arrived, published or not.

        It has the number under which it is published on the output named ``output``. If pacing leaves it out
        there, it has the number of the last message before it. None if no such frame has arrived.
        """
        numbers = self._components[component]
        if numbers.plan is None or numbers.plan.newest is None:
            return None
        frame, stamp = numbers.plan.newest
        encoder = numbers.plan.numbered.encoders[numbers][-1]
        message = encoder.message(frame.body, stamp.prefix(numbers.next - 1))
        paced = self._paced_route(component, output)
        return message if paced is None else paced.numbered(message)

    async def find(self, key: str, output: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages of a key from the history, as they are numbered on the output of this name.

        ``key`` is that of a component, "status", "clock" or "6d/TOOL". None if it has no messages. What
        is too old for the memory comes from the disk, if an output has it there. Raises QueryError (busy).
        """
        component = COMPONENTS_BY_KEY.get(key)
        paced = None if component is None else self._paced_route(component, output)
        if paced is not None:  # the disk has other numbers
            return self.history.find(paced.history_key, wanted)
        found = self.history.find(key, wanted)
        on_disk = self._oldest_recorded(key) if self.history.is_kept else None
        if on_disk is None or (found is not None and found.oldest <= on_disk[1]):
            return found
        disk, oldest, _ = on_disk
        if found is None:
            return await self._recorded(disk, key, wanted)
        if wanted.last_s is not None:
            since_utime = self.history.utime_before(key, wanted.last_s)
            wanted = wanted._replace(since_utime=since_utime, last_s=None)
        is_older = found.first < found.oldest if wanted.first is not None else found.first == found.oldest
        if is_older:
            last = found.oldest - 1 if wanted.last is None else min(wanted.last, found.oldest - 1)
            recorded = await self._recorded(disk, key, wanted._replace(last=last))
            if recorded is not None and (recorded.messages or _goes_on(recorded, wanted, last)):
                return recorded._replace(newest=found.newest)
        return found._replace(oldest=oldest)

    async def _recorded(self, disk: Output, key: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages from the disk; None if it fails, which its output reports."""
        try:
            return await disk.recorded_messages(self._source, key, wanted)
        except QueryError as error:
            if error.code != "disk":
                raise
            return None

    def _oldest_recorded(self, key: str) -> tuple[Output, int, int] | None:
        """Return number and time of the oldest message of a key on the disk, and the output that has it."""
        for route in self._routes:
            oldest = route.output.oldest_recorded(self._source, key)
            if oldest is not None:
                return route.output, *oldest
        return None

    @property
    def history_overview(self) -> dict[str, Any]:
        """What there is of each key, in memory and on the disk."""
        overview = self.history.overview
        for key, facts in overview["keys"].items():
            on_disk = self._oldest_recorded(key)
            if on_disk is not None and on_disk[1] < facts["oldest"]:
                _, facts["oldest"], facts["oldest_utime"] = on_disk
        return overview

    def _paced_route(self, component: ComponentType, output: str) -> TopicRoute | None:
        """Return the route to the output of this name if it numbers a component itself."""
        routes = (route.components.get(component) for route in self._routes if route.output.name == output)
        return next((route for route in routes if route is not None and route.is_paced), None)

    @property
    def outputs(self) -> list[tuple[Output, OutputStatus]]:
        """Each output with its counters for this source."""
        return [(route.output, route.status) for route in self._routes]

    def publish(self, frame: RawFrame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        """Publish the ``wanted`` components of a frame. Raises nothing if an output fails."""
        # This is the inner loop of the gateway; benchmarks/own_cost.py measures it.
        plan = self._plan
        if plan is None or plan.layout is not frame.layout or plan.wanted is not wanted:
            plan = self._change_plan(frame, stamp, wanted)
        for frame_route in plan.frame_routes:
            frame_route.publish(frame, stamp, wanted)
        self._keep(plan, frame, stamp)
        for component in plan.components:
            numbers = component.numbers
            sequence = numbers.next
            numbers.next = sequence + 1
            if component.routes:  # otherwise, nobody needs the message now
                message = component.encoder.message(frame.body, stamp.prefix(sequence))
                for route in component.routes:
                    route.send(message, stamp)
        if plan.tool_indices:
            self._tool_poses.publish(frame, plan.tool_indices, stamp)

    def skip(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> int:
        """Number the messages of these components like ``publish``, but publish nothing.

        Returns how many messages this loses. Messages that pacing leaves out on every output do not count.
        """
        plan = self._change_plan(frame, stamp, components)
        self._keep(plan, frame, stamp)
        num_lost = self._tool_poses.skip(frame, plan.tool_indices)
        for component in plan.components:
            numbers = component.numbers
            message = component.encoder.message(frame.body, stamp.prefix(numbers.next))
            numbers.next += 1
            is_lost = [route.skip(message, stamp) for route in component.routes]
            num_lost += any(is_lost) or bool(plan.frame_routes)
        return num_lost

    def _keep(self, plan: _Plan, frame: RawFrame, stamp: Stamp) -> None:
        """Keep a frame whose messages get the next numbers."""
        plan.newest = frame, stamp
        if plan.components:
            self.history.add_frame(frame.body, plan.numbered, stamp)

    def _change_plan(self, frame: RawFrame, stamp: Stamp, wanted: frozenset[ComponentType]) -> _Plan:
        self._plan = plan = self._plan_for(frame.layout, wanted)
        for component in plan.numbered.encoders:
            self._components[component.type].plan = plan
        if self._item_counts.update(plan.num_items, stamp.session):
            self.on_items_changed()
        return plan

    def _new_plan(self, layout: FrameLayout, wanted: frozenset[ComponentType]) -> _Plan:
        indexed = [pair for pair in enumerate(layout.components) if pair[1].type in wanted]
        plans = [
            _ComponentPlan(
                self._components[component.type],
                ComponentEncoder(layout, index),
                [
                    component_route
                    for route in self._routes
                    if (component_route := route.components.get(component.type)) is not None
                    and not component_route.is_idle
                ],
            )
            for index, component in indexed
        ]
        is_used = self._tool_poses.is_used
        return _Plan(
            *(layout, wanted, plans),
            [route for route in self._frame_routes if plans and route.publisher.prepare(layout, wanted)],
            [index for index, each in indexed if is_used and each.type is ComponentType.TOOLS],
            {each.type: each.num_items for _, each in indexed if each.type is not ComponentType.EVENT},
            NumberedLayout([(plan.numbers, plan.encoder) for plan in plans]),
        )

    def forget_layouts(self) -> None:
        """Forget how to publish earlier frames: the connection ended, or an output wants something else."""
        self._plan_for.cache_clear()
        self._plan = None

    def has_subscribers(self, components: Collection[ComponentType]) -> bool:
        """Return whether any output may have a subscriber to any of ``components``."""
        return any(route.publisher.wants(components) for route in self._frame_routes) or any(
            route.components[component].publisher.wanted
            for route in self._routes
            if route.frame_route is None
            for component in components
        )

    def show_streaming(self, is_streaming: bool) -> None:
        """Show on every output whether frames of the source arrive."""
        self._is_streaming = is_streaming
        for route in self._routes:
            route.output.show_streaming(self._source, is_streaming)

    def show_measurement(self, is_running: bool | None) -> None:
        """Show on every output whether a measurement runs on the server; None if that is unknown."""
        if is_running is not self._is_measuring:
            self._is_measuring = is_running
            for route in self._routes:
                route.output.show_measurement(self._source, is_running)

    def maintain(self) -> None:
        """Log the end of each period in which messages were lost, and drop old ones. Called once a second."""
        self.history.begin_block()
        for route in self._routes:
            route.losses.check()
        self._item_counts.check()

    def end_losses(self) -> None:
        """Log what was lost and is not logged yet, because the gateway stops."""
        for route in self._routes:
            route.losses.close()

    def publish_status(self, message: bytes) -> None:
        """Publish an encoded ``status_t``."""
        self.history.add("status", message)
        for route in self._routes:
            if not route.status_route.is_idle:
                route.status_route.send(message)

    def publish_clock(self, message: bytes) -> None:
        """Publish an encoded ``clock_t``."""
        self.history.add("clock", message)
        for route in self._routes:
            if not route.clock_route.is_idle:
                route.clock_route.send(message)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Set the labels (§6.3) and the coordinate frame for the poses per tool."""
        self._tool_poses.set_parameters(parameters)

    def begin(self, parameters: ServerParameters) -> None:
        """Set the coordinate frame before the server has given any parameters, because some never do.

        Outputs of whole frames get these empty parameters; those of messages have nothing to publish yet.
        """
        self.set_parameters(parameters)
        for route in self._routes:
            if route.frame_route is not None:
                route.output.publish_parameters(self._source, parameters)


def _goes_on(recorded: FoundMessages, wanted: WantedMessages, last: int) -> bool:
    """Return whether the disk may have more up to ``last``: a slow one gives a part, which may be empty."""
    return recorded.last < last and (wanted.first is None or recorded.last >= wanted.first)
