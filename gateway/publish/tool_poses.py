"""Poses per tool: one topic per tool, named after its label, on the outputs that are configured for it."""

from collections.abc import Sequence
from typing import Final

import rtc3d

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.source_frame import unknown_unit_text
from gateway.messages.encode import Stamp, tool_poses
from gateway.messages.history import MessageHistory
from gateway.messages.topics import JSON_NAME, MAX_LABEL_LENGTH, unique_name
from gateway.outputs.contract import ServerParameters
from gateway.publish.routes import OutputRoute, TopicRoute
from gateway.rtc3d.components import Component, ComponentType
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters import Parameters

_MAX_REMEMBERED_NAMES: Final = 1024
"""How many names of tools keep their sequence numbers. The server determines the names."""

_MAX_TOOLS: Final = 256
"""How many tools can have topics of their own. The server determines the number of tools in a frame."""


class _ToolRoutes:
    """One tool's topic: its name, and its route to each output."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.routes: dict[OutputRoute, TopicRoute] = {}

    @property
    def is_wanted(self) -> bool:
        """Whether any output may have a subscriber to the topic."""
        return any(route.publisher.wanted for route in self.routes.values())

    def set_routes(self, output_routes: Sequence[OutputRoute]) -> None:
        """Open the routes that are missing, and close those to other outputs."""
        path = (ComponentType.TOOLS.key, self.name)
        for output_route in self.routes.keys() - set(output_routes):
            self.routes.pop(output_route).publisher.close()
        for output_route in output_routes:
            if output_route not in self.routes:
                self.routes[output_route] = TopicRoute(output_route, path, rtc3d.tool_pose_t, "6d/tool")


class ToolPoses:
    """Publishes the poses of one source's tools, in SI units, on topics named after their labels."""

    def __init__(self, history: MessageHistory) -> None:
        self._history = history
        self._output_routes: Sequence[OutputRoute] = ()
        self._labels: tuple[str, ...] = ()
        self._parameters = Parameters()
        self._frame = CoordinateFrame("")
        self._tools: list[_ToolRoutes] = []
        self._sequences: dict[str, int] = {}  # by the tools' names, also former ones

    @property
    def is_used(self) -> bool:
        """Whether any output publishes poses per tool."""
        return bool(self._output_routes)

    def set_routes(self, output_routes: Sequence[OutputRoute]) -> None:
        """Publish on these outputs from now on. Topics on outputs that stay are not touched."""
        self._output_routes = output_routes
        for tool in self._tools:
            tool.set_routes(output_routes)

    def set_parameters(self, parameters: ServerParameters) -> None:
        """Set the tools' labels (§6.3) and the frame of their poses, which has the unit of length (§6.2)."""
        parsed = parameters.parsed
        labels = () if parsed.tools is None else tuple(tool.label for tool in parsed.tools.tools)
        if labels != self._labels:
            self._labels = labels
            for tool in self._tools:
                tool.set_routes(())
            self._tools.clear()
        self._parameters = parsed
        self._frame = parameters.frame

    def publish(self, frame: RawFrame, indices: Sequence[int], stamp: Stamp) -> None:
        """Publish the pose of each tool in the frame's components at ``indices``, if there are subscribers.

        Usually that is one component.
        """
        num_tools = _num_tools(frame, indices)
        if self._frame.metres_per_unit is None:
            # Publish nothing: a robot that waits is better than one that moves by a guessed unit.
            text = unknown_unit_text(self._parameters, "tool poses")
            self._count_loss("unknown unit", text, num_tools)
            self.skip(frame, indices)
            return
        if num_tools > _MAX_TOOLS:
            self._count_loss(
                "too many tools",
                f"a frame of {num_tools} tools, more than {_MAX_TOOLS}: no tool poses are published",
                num_tools,
            )
            return
        # Topics stay open when a frame has fewer tools: the number may go up and down.
        most_tools = max(frame.layout.components[index].num_items for index in indices)
        if most_tools > len(self._tools):
            self._open_topics(most_tools)
        if any(tool.is_wanted for tool in self._tools):
            for index in indices:
                self._send(frame.component(index), stamp)

    def skip(self, frame: RawFrame, indices: Sequence[int]) -> int:
        """Use up the numbers of the poses that ``publish`` would publish; return how many poses that are."""
        num_skipped = 0
        for index in indices if _num_tools(frame, indices) <= _MAX_TOOLS else ():
            num_tools = frame.layout.components[index].num_items
            wanted = [tool.name for tool in self._tools[:num_tools] if tool.is_wanted]
            for name in wanted:
                self._sequences[name] += 1
            num_skipped += len(wanted)
        return num_skipped

    def _send(self, component: Component, stamp: Stamp) -> None:
        tools = self._tools[: component.num_items]
        sequences = [self._sequences[tool.name] for tool in tools]
        messages = tool_poses(component, stamp, sequences, self._frame)
        for tool, message in zip(tools, messages, strict=True):
            if not tool.is_wanted:  # not sent, but not lost either
                continue
            self._history.add(_key(tool.name), message)
            for route in tool.routes.values():
                if route.publisher.wanted:
                    route.send(message, stamp)
            self._sequences[tool.name] += 1

    def _count_loss(self, cause: str, text: str, num_tools: int) -> None:
        for output_route in self._output_routes if num_tools else ():
            output_route.losses.lost(cause, text, messages=num_tools)

    def _open_topics(self, num_tools: int) -> None:
        """Open what is missing of ``num_tools`` topics. A name that had a topic before continues counting."""
        names = {JSON_NAME} | {tool.name for tool in self._tools}
        for index in range(len(self._tools), num_tools):
            label = self._labels[index].strip() if index < len(self._labels) else ""
            name = unique_name(label or f"tool {index + 1}", names, MAX_LABEL_LENGTH)
            names.add(name)
            if name not in self._sequences:
                self._history.forget(_key(name))
            self._sequences[name] = self._sequences.pop(name, 0)  # the newest names are at the end
            tool = _ToolRoutes(name)
            tool.set_routes(self._output_routes)
            self._tools.append(tool)
        for name in list(self._sequences)[:-_MAX_REMEMBERED_NAMES]:
            del self._sequences[name]


def _key(name: str) -> str:
    return f"{ComponentType.TOOLS.key}/{name}"


def _num_tools(frame: RawFrame, indices: Sequence[int]) -> int:
    return sum(frame.layout.components[index].num_items for index in indices)
