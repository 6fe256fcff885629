"""A source on ROS 2 without Zenoh: the test makes the sending thread's calls, and says who subscribes."""

import logging
import struct
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import pytest

from gateway.errors import OutputError
from gateway.messages.ros2.encode import TF_MESSAGE
from gateway.outputs.adapters.ros2.latched import StaticTransforms
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.adapters.ros2.source import RosSource
from gateway.outputs.adapters.ros2.topic import RosTopic
from gateway.outputs.contract import OutputHealth, ServerParameters
from gateway.outputs.zenoh.confirmation import SentMessages
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import RawFrame
from gateway.runtime.losses import Losses
from tests.support import ros_messages as ros
from tests.support.ros_lab import ALL, stamp
from tests.support.statuses import amounts


def cause_of(publish: Callable[..., None], *arguments: object) -> str:
    """Return the cause of the refusal of a message."""
    with pytest.raises(OutputError) as refused:
        publish(*arguments)
    return refused.value.cause


class Node:
    """A RosNode that records what is declared; ``sent`` are the numbers of messages by topic."""

    def __init__(self) -> None:
        self.events: list[str] = []
        self.sent: dict[str, list[int]] = {}
        self.source_times_ns: list[int] = []
        self.messages: dict[str, list[bytes]] = {}
        self.matching: set[str] = set()
        self.put: Callable[[], None] = lambda: None
        """Called for each message; it may raise an exception."""

    def declare(self, topic: RosTopic, on_matching: Callable[[bool], None]) -> "_Declared":
        self.events.append(f"+{topic.name}")
        return _Declared(self, topic.name, on_matching)

    @property
    def open(self) -> set[str]:
        """The topics that are declared now, without those of labels."""
        names = [event[1:] for event in self.events]
        return {name for name in names if names.count(name) % 2 and not name.endswith("/labels")}


class _Declared:
    """What a Node declares for one topic; also its publisher, and whether that matches."""

    gid = bytes(16)

    def __init__(self, node: Node, name: str, on_matching: Callable[[bool], None]) -> None:
        self.publisher = self.matching_status = self
        self._node, self._name, self._on_matching = node, name, on_matching

    @property
    def matching(self) -> bool:
        return self._name in self._node.matching

    def put(self, cdr: bytes, attachment: bytes) -> None:
        self._node.put()
        number, source_time_ns = struct.unpack_from("<qq", attachment)
        self._node.sent.setdefault(self._name, []).append(number)
        self._node.source_times_ns.append(source_time_ns)
        self._node.messages.setdefault(self._name, []).append(cdr)

    def undeclare(self) -> None:
        self._node.events.append(f"-{self._name}")


class Router:
    """A SessionHolder without a session."""

    def __init__(self, *_: Any) -> None:
        self.is_cut_off = False
        self.is_client = True
        self.session = None
        self.events: list[str] = []

    @property
    def refusal(self) -> OutputError:
        return OutputError("the router is gone", cause="no router")

    @property
    def health(self) -> OutputHealth:
        return OutputHealth(not self.is_cut_off)

    def start(self) -> None:
        self.events.append("start")

    def maintain(self) -> None:
        self.events.append("maintain")

    def close(self) -> None:
        self.events.append("close")


class Sender:
    """A sending thread whose calls the test makes with ``run``."""

    def __init__(self, *_: Any) -> None:
        self.calls: list[Callable[[], None]] = []
        self.offered_bytes: list[int] = []
        self.is_full = self.is_closed = False
        self.call_age_s = 0.0

    def offer(self, call: Callable[[], None], num_bytes: int = 0) -> bool:
        if not self.is_full:
            self.calls.append(call)
            self.offered_bytes.append(num_bytes)
        return not self.is_full

    def submit(self, call: Callable[[], None]) -> Future[None]:
        self.calls.insert(0, call)
        done: Future[None] = Future()
        done.set_result(None)
        return done

    def run(self) -> None:
        while self.calls:
            self.calls.pop(0)()

    def close(self) -> None:
        self.is_closed = True


class Source:
    """The source "lab", declared on a node. ``changes`` is what was wanted after each change."""

    def __init__(
        self,
        given: ServerParameters | None = None,
        *,
        is_declared: bool = True,
        tools: Mapping[str, Any] | None = None,
    ) -> None:
        settings = Ros2Settings.model_validate({"tools": {"lab": tools or {}}})
        self.node, self.router, self.sender = Node(), Router(), Sender()
        self.tf = RosTopic("/tf", TF_MESSAGE, self._update_wanted)
        self.static = StaticTransforms(self._send_static)
        self.messages_sent = SentMessages()
        router: Any = self.router
        sender: Any = self.sender
        self.publisher = RosSource(
            *(
                "lab",
                "/mocap/lab",
                self.tf,
                self.static,
                settings.tools["lab"],
                router,
                sender,
                self.messages_sent,
            )
        )
        self.publisher.losses = Losses(logging.getLogger("tests"), "lab to ros2")
        self.num_changes = 0
        self.publisher.on_wanted_changed = self._note_change
        if is_declared:
            self.declare()
        if given is not None:
            self.use(given)

    def _update_wanted(self) -> None:
        self.publisher.update_wanted()

    def _send_static(self) -> None:
        self.static.send()

    def _note_change(self) -> None:
        self.num_changes += 1

    def declare(self) -> None:
        self.tf.declare(self.node)  # type: ignore[arg-type]
        self.static.declare(self.node)  # type: ignore[arg-type]
        self.publisher.declare(self.node)  # type: ignore[arg-type]

    def subscribe(self, *names: str, is_there: bool = True) -> None:
        """Let subscribers come to these topics, or to all but that of labels; or go."""
        labels = self.publisher._labels._topic
        for topic in (self.tf, self.static._topic, labels, *self.publisher.topics):
            if topic.name in (names or [topic.name]) and (names or topic is not labels):
                topic._on_matching(is_there)

    def offer(self, frame: RawFrame, components: frozenset[ComponentType] = ALL) -> None:
        self.publisher.publish(frame, stamp(), components)

    def send(self, frame: RawFrame, components: frozenset[ComponentType] = ALL) -> None:
        self.offer(frame, components)
        self.sender.run()

    @property
    def sent(self) -> Mapping[str, list[int]]:
        """The numbers of the messages by topic."""
        return {name.removeprefix("/mocap/lab/"): numbers for name, numbers in self.node.sent.items()}

    def message(self, name: str, type_name: str) -> Any:
        """Return the only message of a topic."""
        [cdr] = self.node.messages[name if name.startswith("/") else f"/mocap/lab/{name}"]
        return ros.decoded(cdr, type_name)

    def use(self, given: ServerParameters) -> None:
        self.publisher.set_parameters(given)
        self.sender.run()

    @property
    def lost(self) -> dict[str, tuple[int, int]]:
        return amounts(self.publisher.losses.report())
