"""The session with the router of ROS 2, and the topics of the node on it, without Zenoh."""

import json
import logging
from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh

from gateway.outputs.ros2 import router as router_module
from gateway.outputs.ros2.message_types import POINT_CLOUD
from gateway.outputs.ros2.router import RouterSession, client_config
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.outputs.ros2.topic import RosNode, RosTopic

ENDPOINT = "tcp/192.0.2.9:7447"


def event(*, is_open: bool) -> Mock:
    """Return what RouterSession uses of a zenoh.TransportEvent."""
    return Mock(kind=zenoh.SampleKind.PUT if is_open else zenoh.SampleKind.DELETE)


class Lab:
    """A RouterSession whose zenoh.open fails as often as there are ``errors``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, num_errors: int = 0) -> None:
        self.session = Mock()
        self.listen = self.session.info.declare_transport_events_listener
        self.errors = [zenoh.ZError("refused") for _ in range(num_errors)]
        self.opened: list[object] = []
        self.closed: list[object] = []
        self.waits_s: list[object] = []
        self.before_open: Callable[[], None] = lambda: None
        monkeypatch.setattr(zenoh, "open", self._open)
        monkeypatch.setattr(router_module, "close_session", lambda session, _: self.closed.append(session))
        self.router = RouterSession(ENDPOINT, self.opened.append)
        monkeypatch.setattr(self.router._closing, "wait", self.waits_s.append)

    def _open(self, _config: zenoh.Config) -> Mock:
        self.before_open()
        if self.errors:
            raise self.errors.pop()
        return self.session

    def open(self) -> None:
        """Do what the opening thread does."""
        self.router._open()

    def transport(self, *, is_open: bool) -> None:
        """Tell the gateway that the router has come or gone."""
        self.listen.call_args.args[0].callback(event(is_open=is_open))


def test_a_client_of_the_router_searches_for_no_others_and_waits_for_it() -> None:
    """Zenoh drops messages uncounted if it does not wait; multicast would find other routers."""
    config = client_config(ENDPOINT)
    expected = {"mode": "client", "connect/endpoints": [ENDPOINT], "scouting/multicast/enabled": False}
    assert {key: json.loads(config.get_json(key)) for key in expected} == expected
    key = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
    assert json.loads(config.get_json(key)) > 10_000_000


def test_the_session_is_opened_as_soon_as_there_is_a_router(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A second after each failure; until then, the health says where the router should be."""
    caplog.set_level(logging.INFO)
    lab = Lab(monkeypatch, num_errors=3)
    problems: list[str] = []
    lab.before_open = lambda: problems.append(lab.router.health.problem)
    lab.open()
    assert lab.waits_s == [1.0] * 3
    assert "not open yet" in problems[0]
    assert all(ENDPOINT in each and "no Zenoh router" in each for each in problems[1:])
    assert lab.opened == [lab.session]
    assert (lab.listen.call_args.args[0].indirect, lab.listen.call_args.kwargs) == (False, {"history": True})
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
    lab.listen.side_effect = lambda events, *, history: events.callback(event(is_open=history))
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
    assert (late.opened, late.session.close.call_count, late.closed) == ([], 1, [])
    late.open()
    assert len(late.waits_s) == 2


@pytest.mark.parametrize(
    ("reliability", "zenoh_reliability"),
    [("best_effort", zenoh.Reliability.BEST_EFFORT), ("reliable", zenoh.Reliability.RELIABLE)],
)
def test_a_topic_is_a_publisher_and_a_token_with_an_id_of_its_own(
    reliability: Any, zenoh_reliability: zenoh.Reliability
) -> None:
    """A slow node must not block the gateway, and ROS tells publishers apart by their ids."""
    session = Mock()
    declare_token = session.liveliness.return_value.declare_token
    node = RosNode(session, Ros2Settings(reliability=reliability, depth=3))
    changes: list[int] = []
    topics = [RosTopic(name, POINT_CLOUD, lambda: changes.append(1)) for name in ("/a", "/b")]
    for topic in (*topics, *topics):  # what is declared is not declared again
        topic.declare(node)
    used = {"congestion_control": zenoh.CongestionControl.DROP, "reliability": zenoh_reliability}
    assert [each.kwargs for each in session.declare_publisher.call_args_list] == [used] * 2
    tokens = [each.args[0] for each in declare_token.call_args_list]
    assert [token.split("/")[4:6] for token in tokens] == [["0", "NN"], ["1", "MP"], ["2", "MP"]]
    assert all(",3:" in token for token in tokens[1:])
    assert len({topic._declared and topic._declared.gid for topic in topics}) == 2
    listener = session.declare_publisher.return_value.declare_matching_listener.call_args.args[0]
    assert not listener.indirect
    for is_matching in (True, True):
        listener.callback(Mock(matching=is_matching))
    assert ([topic.wanted for topic in topics], changes) == ([False, True], [1])
    for topic in topics:
        topic.undeclare()
        topic.undeclare()
    assert [str(each) for each in session.mock_calls if "undeclare" in str(each)] == [
        *("call.liveliness().declare_token().undeclare()", "call.declare_publisher().undeclare()") * 2
    ]
    assert (topics[1].wanted, changes) == (False, [1])
    topics[1].declare(node)
    declare_token.return_value.undeclare.side_effect = zenoh.ZError("gone")
    topics[1].undeclare()
