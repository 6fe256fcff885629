"""The node on ROS 2 without Zenoh: its session and router, its sources and topics, and the diagnostics."""

import asyncio
import json
import logging
import threading
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.no_topics import IgnoringPublisher
from gateway.outputs.ros2 import diagnostics as diagnostics_module
from gateway.outputs.ros2 import output as output_module
from gateway.outputs.ros2 import router as router_module
from gateway.outputs.ros2.diagnostics import DiagnosticsPublisher
from gateway.outputs.ros2.message_types import POINT_CLOUD
from gateway.outputs.ros2.messages import DiagnosticStatus
from gateway.outputs.ros2.output import Ros2Output
from gateway.outputs.ros2.router import RouterSession, client_config
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.ros2.source import RosSource
from gateway.outputs.ros2.topic import RosNode, RosTopic
from tests.ros_lab import ALL, parameters
from tests.unit.outputs.ros2.scripted_ros import Node, Router, Sender
from tests.unit.outputs.ros2.test_diagnostics import example_status

ENDPOINT = "tcp/192.0.2.9:7447"


# The session --------------------------------------------------------------------------------


class Session:
    """A Zenoh session; ``transport`` tells the gateway that the router has come or gone."""

    def __init__(self) -> None:
        self.info = self
        self.transport: Callable[[Any], None] = lambda _: None
        self.is_direct = self.has_history = self.is_closed = False

    def declare_transport_events_listener(self, events: Any, *, history: bool) -> None:
        self.transport, self.is_direct, self.has_history = events.callback, not events.indirect, history

    def close(self) -> None:
        self.is_closed = True


class Event:
    """What RouterSession uses of a zenoh.TransportEvent."""

    def __init__(self, *, is_open: bool) -> None:
        self.kind = zenoh.SampleKind.PUT if is_open else zenoh.SampleKind.DELETE


class Closing:
    """The event that ends the opening thread; ``waits_s`` are the waits between tries."""

    def __init__(self) -> None:
        self.waits_s: list[float] = []
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True

    def wait(self, timeout_s: float) -> None:
        self.waits_s.append(timeout_s)


class Lab:
    """A RouterSession whose zenoh.open fails as often as there are ``errors``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, num_errors: int = 0) -> None:
        self.session = Session()
        self.opened: list[object] = []
        self.errors = [zenoh.ZError("refused") for _ in range(num_errors)]
        self.closed: list[object] = []
        self.before_open: Callable[[], None] = lambda: None
        monkeypatch.setattr(zenoh, "open", self._open)
        monkeypatch.setattr(router_module, "close_session", lambda session, _: self.closed.append(session))
        self.router = RouterSession(ENDPOINT, self.opened.append)
        self.closing = self.router._closing = Closing()  # type: ignore[assignment]

    def _open(self, _config: zenoh.Config) -> Session:
        self.before_open()
        if self.errors:
            raise self.errors.pop()
        return self.session

    def open(self) -> None:
        """Do what the opening thread does."""
        self.router._open()

    def transport(self, *, is_open: bool) -> None:
        self.session.transport(Event(is_open=is_open))


def test_a_client_of_the_router_searches_for_no_others_and_waits_for_it() -> None:
    """Zenoh drops messages uncounted if it does not wait; multicast would find other routers."""
    config = client_config(ENDPOINT)
    found = {
        key: json.loads(config.get_json(key))
        for key in ("mode", "connect/endpoints", "scouting/multicast/enabled")
    }
    assert found == {"mode": "client", "connect/endpoints": [ENDPOINT], "scouting/multicast/enabled": False}
    key = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
    assert json.loads(config.get_json(key)) > 10_000_000


def test_the_session_is_opened_as_soon_as_there_is_a_router(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A second after each failure; until then, the health says where the router should be."""
    caplog.set_level(logging.INFO)
    lab = Lab(monkeypatch, num_errors=3)
    assert "not open yet" in lab.router.health.problem
    problems: list[str] = []
    lab.before_open = lambda: problems.append(lab.router.health.problem)
    lab.open()
    assert lab.closing.waits_s == [1.0] * 3
    assert [ENDPOINT in each and "no Zenoh router" in each for each in problems] == [False, True, True, True]
    assert lab.opened == [lab.session]
    assert (lab.session.is_direct, lab.session.has_history) == (True, True)
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


def test_without_a_transport_nothing_can_be_sent(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Zenoh keeps a session without its router; several links of one router are one connection."""
    lab = Lab(monkeypatch)
    router = lab.router
    assert (router.is_cut_off, router.refusal.cause) == (True, "not open")
    lab.open()
    assert (router.is_cut_off, router.refusal.cause) == (True, "no router")
    for is_open, is_cut_off in ((True, False), (True, False), (False, False), (False, True), (True, False)):
        lab.transport(is_open=is_open)
        assert (router.is_cut_off, router.health.connected) == (is_cut_off, not is_cut_off)
    caplog.set_level(logging.INFO)
    caplog.clear()
    for is_open in (True, False, False, True):
        lab.transport(is_open=is_open)
        router.maintain()
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]


def test_a_router_that_connects_while_the_session_opens_is_not_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its event comes before the session is known."""
    lab = Lab(monkeypatch)
    lab.session.declare_transport_events_listener = (  # type: ignore[method-assign]
        lambda events, *, history: events.callback(Event(is_open=history))
    )
    lab.open()
    assert not lab.router.is_cut_off


def test_closing_ends_the_session_and_the_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session that opens too late is closed again, and nothing is declared on it."""
    lab = Lab(monkeypatch)
    lab.open()
    lab.transport(is_open=True)
    lab.router.close()
    lab.router.close()
    assert (lab.closed, lab.router.is_cut_off) == ([lab.session], True)
    assert "closed" in lab.router.health.problem
    lab.router.maintain()

    late = Lab(monkeypatch, num_errors=2)

    def close_at_last() -> None:
        if not late.errors:
            late.router.close()

    late.before_open = close_at_last
    late.open()
    assert (late.opened, late.session.is_closed, late.closed) == ([], True, [])
    late.open()
    assert len(late.closing.waits_s) == 2


# Topics on a node ---------------------------------------------------------------------------


class ZenohSession:
    """A session that records what is declared."""

    def __init__(self) -> None:
        self.info = self
        self.tokens: list[str] = []
        self.undeclared: list[str] = []
        self.publishers: list[tuple[str, zenoh.CongestionControl, zenoh.Reliability]] = []
        self.listeners: list[Any] = []
        self.error: Exception | None = None

    def zid(self) -> str:
        return "abc"

    def liveliness(self) -> "ZenohSession":
        return self

    def declare_token(self, key: str) -> "Token":
        self.tokens.append(key)
        return Token(self, "token")

    def declare_publisher(
        self, key: str, *, congestion_control: zenoh.CongestionControl, reliability: zenoh.Reliability
    ) -> "Token":
        self.publishers.append((key, congestion_control, reliability))
        return Token(self, "publisher")


class Token:
    """A liveliness token or a publisher."""

    def __init__(self, session: ZenohSession, kind: str) -> None:
        self._session, self._kind = session, kind

    def declare_matching_listener(self, listener: Any) -> None:
        self._session.listeners.append(listener)

    def undeclare(self) -> None:
        if self._session.error is not None:
            raise self._session.error
        self._session.undeclared.append(self._kind)


@pytest.mark.parametrize(
    ("reliability", "zenoh_reliability"),
    [("best_effort", zenoh.Reliability.BEST_EFFORT), ("reliable", zenoh.Reliability.RELIABLE)],
)
def test_a_topic_is_a_publisher_and_a_token_with_an_id_of_its_own(
    reliability: Any, zenoh_reliability: zenoh.Reliability
) -> None:
    """A slow node must not block the gateway, and ROS tells publishers apart by their ids."""
    session = ZenohSession()
    node = RosNode(session, Ros2Settings(reliability=reliability, depth=3))  # type: ignore[arg-type]
    changes: list[int] = []
    topics = [RosTopic(name, POINT_CLOUD, lambda: changes.append(1)) for name in ("/a", "/b")]
    for topic in (*topics, *topics):  # what is declared is not declared again
        topic.declare(node)
    assert [each[1:] for each in session.publishers] == [
        (zenoh.CongestionControl.DROP, zenoh_reliability)
    ] * 2
    assert [key.split("/")[4:6] for key in session.tokens] == [["0", "NN"], ["1", "MP"], ["2", "MP"]]
    assert all(f",{3}:" in key for key in session.tokens[1:])
    [listener, _] = session.listeners
    assert not listener.indirect
    for topic in topics:
        topic.undeclare()
        topic.undeclare()
    assert session.undeclared == ["token", "publisher"] * 2
    for _ in range(2):
        topics[0]._on_matching(True)
    topics[0].undeclare()
    assert (topics[0].wanted, changes) == (False, [1])
    topics[1].declare(node)
    session.error = zenoh.ZError("gone")
    topics[1].undeclare()


# The output ---------------------------------------------------------------------------------


class Output:
    """The output with a scripted router, sending thread and node."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> None:
        self.node, self.sender = Node(), Sender()
        monkeypatch.setattr(output_module, "RouterSession", Router)
        monkeypatch.setattr(output_module, "SendThread", lambda _: self.sender)
        monkeypatch.setattr(output_module, "RosNode", lambda *_: self.node)
        self.output = Ros2Output(Ros2Settings(enabled=True, **settings))
        self.router: Any = self.output._router

    def open(self) -> None:
        self.output._on_open(None)  # type: ignore[arg-type]
        self.sender.run()

    def source(self, name: str, *labels: str) -> RosSource:
        publisher = self.output.frame_publisher(name)
        assert isinstance(publisher, RosSource)
        self.output.publish_parameters(name, parameters(labels))
        self.sender.run()
        return publisher

    def match(self, *names: str) -> None:
        """Let subscribers of these topics have come unnoticed."""
        self.node.matching = set(names)
        self.output.maintain()
        self.sender.run()


def test_sources_are_declared_whether_they_come_before_the_session_or_after(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The router may come at any time."""
    lab = Output(monkeypatch)
    lab.output.start()
    assert lab.router.events == ["start"]
    lab.source("lab", "wand")
    assert lab.node.open == set()
    lab.open()
    assert lab.node.open == {"/tf", "/diagnostics", "/mocap/lab/wand/pose"}
    hall = lab.source("hall", "cup")
    assert "/mocap/hall/cup/pose" in lab.node.open
    hall.close()
    lab.output.withdraw("hall")
    assert lab.output.topic_names("hall") == {}
    lab.sender.run()
    assert "/mocap/hall/cup/pose" not in lab.node.open
    lab.source("hall", "cup")  # again, under the same name
    assert "/mocap/hall/cup/pose" in lab.node.open


def test_sources_whose_names_are_alike_in_ros_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a namespace, topics begin with the source."""
    lab = Output(monkeypatch, namespace="")
    lab.output.start()
    lab.open()
    for name in ("a-b", "a b", "a-b"):
        lab.source(name, "wand")
    assert {each[1:] for each in lab.node.events if "wand" in each} == {"/a_b/wand/pose", "/a_b_2/wand/pose"}
    assert lab.output.topic_names("a-b") == {"6d": {}}
    assert lab.output.topic_names("elsewhere") == {}


def test_maintenance_finds_subscribers_that_were_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every topic; while a check waits, no other one is queued, nor without a router."""
    lab = Output(monkeypatch)
    lab.output.start()
    lab.open()
    publishers = [lab.source(name, "wand") for name in ("lab", "hall")]
    lab.match("/mocap/lab/wand/pose")
    assert [each.wants(ALL) for each in publishers] == [True, False]
    lab.match("/tf", "/diagnostics")
    assert [each.wants(ALL) for each in publishers] == [True, True]
    assert lab.output._diagnostics.wanted
    lab.match()
    assert [each.wants(ALL) for each in publishers] == [False, False]
    for _ in range(3):
        lab.output.maintain()
    assert len(lab.sender.calls) == 1
    lab.sender.run()
    lab.router.is_cut_off = True
    lab.output.maintain()
    assert lab.sender.calls == []
    assert lab.router.events.count("maintain") == 7


async def test_subscribers_of_shared_topics_concern_every_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each source decides anew whether its server has to send; the status counts, too."""
    lab = Output(monkeypatch)
    lab.output.start()
    lab.open()
    changes: list[str] = []
    for name in ("lab", "hall"):
        lab.source(name, "wand")
        assert lab.output.watch_wanted(name, lambda name=name: changes.append(name))  # type: ignore[misc]
    for topic in (lab.output._tf, lab.output._diagnostics):
        await asyncio.to_thread(topic._on_matching, True)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert sorted(changes) == ["hall", "lab"]
        changes.clear()


def test_only_equal_settings_are_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reload without changes disturbs no node."""
    one, other = Output(monkeypatch).output, Output(monkeypatch, domain_id=1).output
    assert one.is_configured_like(Output(monkeypatch).output)
    assert not one.is_configured_like(other)


def test_closing_ends_the_thread_and_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is queued afterwards."""
    lab = Output(monkeypatch)
    assert not lab.output.offer(lambda: None)
    lab.output.start()
    lab.output.close()
    lab.output.close()
    assert lab.sender.is_closed
    assert lab.router.events == ["start", "close", "close"]
    assert not lab.output.offer(lambda: None)
    lab.output.submit(lambda: None)
    assert lab.sender.calls == []


# Diagnostics --------------------------------------------------------------------------------


def test_a_status_is_published_while_somebody_subscribes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock is not for ROS; what cannot be sent is refused with its cause."""
    lab = Output(monkeypatch)
    lab.output.start()
    lab.open()
    assert isinstance(lab.output.publisher(Topic("lab", ("clock",), "rtc3d.clock_t")), IgnoringPublisher)
    publisher = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    assert isinstance(publisher, DiagnosticsPublisher)
    status = example_status()
    publisher.publish(status)
    assert (publisher.wanted, lab.sender.calls) == (False, [])
    lab.output._diagnostics._on_matching(True)
    seen: list[object] = []

    def note(_now: object, before: object, _names: object) -> list[DiagnosticStatus]:
        seen.append(before)
        return []

    monkeypatch.setattr(diagnostics_module, "diagnostics_of", note)
    publisher.publish(status)
    publisher.publish(status)
    assert lab.sender.offered_bytes[-1] == len(status)
    lab.sender.run()
    assert lab.node.sent == {"/diagnostics": [1, 2]}
    assert [each is None for each in seen] == [True, False]
    assert publisher._previous is not seen[1]
    lab.sender.is_full = True
    assert cause_of(publisher, status) == "queue full"
    lab.router.is_cut_off = True
    assert cause_of(publisher, status) == "no router"
    publisher.close()
    assert cause_of(publisher, status) == "closed"
    assert not publisher.wanted


def cause_of(publisher: DiagnosticsPublisher, status: bytes) -> str:
    with pytest.raises(OutputError) as refused:
        publisher.publish(status)
    return refused.value.cause


def test_an_output_that_was_never_started_has_no_threads() -> None:
    """The doctor and the configuration only look at it."""
    before = threading.active_count()
    output = Ros2Output(Ros2Settings(enabled=True))
    output.frame_publisher("lab")
    output.publish_parameters("lab", parameters(("wand",)))
    assert threading.active_count() == before
    output.close()
    assert not output.health().connected
