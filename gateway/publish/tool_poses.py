"""The messages per tool: SI poses, on keys that carry the tools' labels."""

import logging
from collections.abc import Iterable
from typing import Final

import rtc3d

from gateway.log import HOLD_S, FailureLog
from gateway.messages.splice import lcm_type_name
from gateway.messages.stamp import Stamp
from gateway.messages.tool_pose import metres_per_unit, tool_poses
from gateway.messages.topics import MAX_LABEL_LENGTH, Topic, unique_name
from gateway.outputs.contract import Publisher
from gateway.publish.routes import OutputRoute
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame
from gateway.rtc3d.parameters import Parameters

_MAX_TOOLS: Final = 256
"""How many tools get a key of their own; the count in a frame is the server's word."""

logger = logging.getLogger(__name__)


_Sending = list[tuple[OutputRoute, Publisher]]


def _declared(ways: Iterable[OutputRoute], topic: Topic, before: _Sending) -> _Sending:
    """Return a publisher of ``topic`` for each way, new ones and those there were; the others are closed."""
    kept = dict(before)
    sending = [(way, kept.pop(way) if way in kept else way.output.publisher(topic)) for way in ways]
    for publisher in kept.values():
        publisher.close()
    return sending


class ToolPoses:
    """The messages per tool: SI poses, on keys that carry the tools' labels."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._ways: list[OutputRoute] = []
        self._labels: tuple[str, ...] = ()
        self._metres: float | None = 1e-3  # None: the server's unit is unknown
        self._tools: list[tuple[str, _Sending]] = []  # name and publishers of each
        self._publishers: list[Publisher] = []  # all of them
        self._sequences: dict[str, int] = {}  # by name
        self._too_many = FailureLog(logger, source, HOLD_S)
        self._unit = FailureLog(logger, source)

    @property
    def is_used(self) -> bool:
        """Whether there is an output with keys per tool."""
        return bool(self._ways)

    def use(self, ways: list[OutputRoute]) -> None:
        """Publish on these from now on."""
        self._ways = ways
        self._tools = [(name, _declared(ways, self._topic(name), sending)) for name, sending in self._tools]
        self._list_publishers()

    def _list_publishers(self) -> None:
        self._publishers = [publisher for _, sending in self._tools for _, publisher in sending]

    def _topic(self, name: str) -> Topic:
        return Topic(self._source, (ComponentType.TOOLS.key, name), lcm_type_name(rtc3d.tool_pose_t))

    def set_parameters(self, parameters: Parameters) -> None:
        """Take the tools' labels (§6.3) and the unit of length (§6.2)."""
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

    def publish(self, frame: Frame, index: int, stamp: Stamp) -> None:
        """Publish the pose of each tool in the frame's component at ``index`` to whoever listens."""
        if self._metres is None:
            self._drop("unknown unit")
            return
        count = frame.layout.parts[index].num_items
        if count > _MAX_TOOLS:
            self._refuse(count)
            return
        if self._too_many.failing:
            self._too_many.recovered(f"frames of {count} tools; each has a key of its own")
        if count > len(self._tools):
            self._open(count)
        # Fewer than before keep their keys: a count that goes up and down declares nothing anew.
        tools = self._tools[:count]
        for publisher in self._publishers:  # any() takes twice as long, for every frame
            if publisher.wanted:
                break
        else:
            return
        sequences = [self._sequences[name] for name, _ in tools]
        messages = tool_poses(frame.component(index), stamp, sequences, self._metres)
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
            way.drop(cause)

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
        self._list_publishers()

    def _close(self) -> None:
        for _, sending in self._tools:
            for _, publisher in sending:
                publisher.close()
        self._tools.clear()
