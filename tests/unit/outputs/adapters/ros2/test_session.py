"""The section ``ros2``, and the node of ROS 2 with its topics on a session, without Zenoh."""

import json
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh

from gateway.messages.ros2.encode import POINT_CLOUD
from gateway.outputs.adapters.ros2.output import client_config
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.adapters.ros2.topic import RosNode, RosTopic, gid_of
from tests.support.configurations import mistakes

ENDPOINT = "tcp/192.0.2.9:7447"


def test_a_client_of_the_router_searches_for_no_others_and_waits_for_it() -> None:
    """Zenoh drops messages uncounted if it does not wait; multicast would find other routers."""
    config = client_config(ENDPOINT)
    expected = {"mode": "client", "connect/endpoints": [ENDPOINT], "scouting/multicast/enabled": False}
    assert {key: json.loads(config.get_json(key)) for key in expected} == expected
    key = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
    assert json.loads(config.get_json(key)) > 60_000_000  # the lease of rmw_zenohd


def test_a_router_that_pauses_reads_afterwards_what_waits_for_it() -> None:
    """With Zenoh's lease of 10 s, a router paused for 15 s gave the connection up, and all was lost."""
    config = client_config(ENDPOINT)
    link = "transport/link/tx"
    assert [json.loads(config.get_json(f"{link}/{key}")) for key in ("lease", "keep_alive")] == [60_000, 2]


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
    assert [topic._declared and topic._declared.gid for topic in topics] == [*map(gid_of, tokens[1:])]
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
    topics[1].declare(other := RosNode(Mock(), Ros2Settings()))
    topics[1].declare(other)
    assert len(session.declare_publisher.call_args_list) == 3


# Settings -----------------------------------------------------------------------------------


def test_the_defaults_are_those_of_ros() -> None:
    settings = Ros2Settings()
    assert not settings.enabled
    assert (settings.domain_id, settings.namespace, settings.distribution) == (0, "mocap", "jazzy")
    assert settings.connect == "tcp/127.0.0.1:7447"
    assert (settings.reliability, settings.durability, settings.depth) == ("best_effort", "volatile", 10)


@pytest.mark.parametrize(
    ("key", "given", "used"),
    [
        *(("namespace", given, given) for given in ("mocap", "site/hall_2", "", "a" * 100)),
        *(("namespace", f"/{used}", used) for used in ("mocap", "")),
        *(
            ("connect", given, given)
            for given in ("tcp/[::1]:7447", "tcp/robot.example.org:1", "tls/a:65535", "udp/192.0.2.5:7447")
        ),
        *(("domain_id", given, given) for given in (0, 232)),
        *(("distribution", given, given) for given in ("humble", "jazzy", "kilted", "lyrical", "rolling")),
    ],
)
def test_what_is_accepted(key: str, given: object, used: object) -> None:
    assert getattr(Ros2Settings.model_validate({key: given}), key) == used


NAMESPACES = ("2nd", "a b", "a__b", "_a", "a_", "a//b", "a/", "a/2b", "ä", "a" * 101, "~a", "{x}", "a/*")
ENDPOINTS = ("", "192.0.2.5:7447", "tcp/192.0.2.5", "tcp/:7447", "tcp/a:0", "tcp/a:65536", "tcp/a b:1")


@pytest.mark.parametrize(
    ("key", "value", "example"),
    [
        *(("namespace", value, "site/mocap") for value in NAMESPACES),
        *(("connect", value, "tcp/127.0.0.1:7447") for value in ENDPOINTS),
        ("distribution", "jazy", ""),
        ("domain_id", -1, ""),
        ("domain_id", 233, ""),
        ("reliability", "best effort", ""),
        ("durability", "transient_local", ""),
        ("depth", 0, ""),
    ],
)
def test_mistakes(key: str, value: object, example: str) -> None:
    [(place, text)] = mistakes(Ros2Settings, {key: value})
    assert place == key
    assert text.startswith(f"found {value!r}"[:50])
    assert example in text.partition("; expected ")[2]
