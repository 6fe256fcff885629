"""The output for ROS 2: sources, subscribers and life cycle, and what a real router shows of it."""

import asyncio
import logging
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh
import zenoh.ext

from gateway.outputs.adapters.ros2 import output as output_module
from gateway.outputs.adapters.ros2.output import Ros2Output
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.adapters.ros2.source import RosSource
from gateway.outputs.adapters.ros2.topic import gid_of
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import ComponentType
from gateway.runtime.losses import Losses
from tests.support.errors import names
from tests.support.ros_lab import ALL, parameters, ros_lab, stamp, tools_frame
from tests.support.statuses import amounts
from tests.support.waiting import wait_until
from tests.unit.outputs.adapters.ros2.scripted_ros import Node, Router, Sender


class Output:
    """The output with a scripted router, sending thread and node."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, is_open: bool = True, **settings: Any) -> None:
        self.node, self.sender = Node(), Sender()
        monkeypatch.setattr(output_module, "router_session", Router)
        monkeypatch.setattr(output_module, "WorkerThread", lambda _: self.sender)
        monkeypatch.setattr(output_module, "RosNode", lambda *_: self.node)
        self.output = Ros2Output(Ros2Settings(enabled=True, **settings))
        self.router: Any = self.output._router
        if is_open:
            self.output.start()
            self.open()

    def open(self) -> None:
        self.output._declare_in_thread(None)  # type: ignore[arg-type]
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
    lab = Output(monkeypatch, is_open=False)
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
    for name in ("a-b", "a b", "a-b"):
        lab.source(name, "wand")
    assert {each[1:] for each in lab.node.events if "wand" in each} == {"/a_b/wand/pose", "/a_b_2/wand/pose"}
    assert lab.output.topic_names("a-b") == {"6d": {}}
    assert lab.output.topic_names("elsewhere") == {}


def test_without_tf_only_the_topics_of_tools_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """The settings of another source with the same labels are not those of this one."""
    lab = Output(monkeypatch, tf=False, tools={"lab": {"wand": {"name": "hand"}}})
    lab.source("lab", "wand")
    lab.source("hall", "wand")
    assert lab.node.open == {"/diagnostics", "/mocap/lab/hand/pose", "/mocap/hall/wand/pose"}


def test_maintenance_finds_subscribers_that_were_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every topic; while a check waits, no other one is queued, nor without a router."""
    lab = Output(monkeypatch)
    publishers = [lab.source(name, "wand") for name in ("lab", "hall")]
    for topics, wanted in (
        (["/mocap/lab/wand/pose"], [True, False]),
        (["/tf", "/diagnostics"], [True, True]),
        ([], [False, False]),
    ):
        lab.match(*topics)
        assert [each.wants(ALL) for each in publishers] == wanted
        assert lab.output._diagnostics.wanted is ("/diagnostics" in topics)
    for _ in range(3):
        lab.output.maintain()
    assert len(lab.sender.calls) == 1
    lab.sender.run()
    lab.router.is_cut_off = True
    lab.output.maintain()
    assert lab.sender.calls == []
    assert lab.router.events.count("maintain") == 7


def test_messages_that_a_lost_router_has_not_confirmed_count_as_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """A router that was stopped loses what Zenoh has accepted for it: here a pose and its transform."""
    lab = Output(monkeypatch)
    publisher = lab.source("lab", "wand")
    losses = Losses(logging.getLogger("tests"), "lab to ros2")
    lab.output.count_losses("lab", losses)
    lab.match("/tf", "/mocap/lab/wand/pose")
    publisher.publish(tools_frame((1, 2, 3)), stamp(), ALL)
    lab.sender.run()
    lab.output._lose_link()
    lab.output.maintain()
    assert amounts(losses.report()) == {"link lost": (2, 0)}


def test_a_router_that_reads_nothing_is_a_problem_before_the_buffers_are_full(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lab = Output(monkeypatch)
    assert lab.output.health().connected
    monkeypatch.setattr(lab.output, "_confirmation", Mock(silent_s=7.0))
    assert not lab.output.health().connected


async def test_subscribers_of_shared_topics_concern_every_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each source decides anew whether its server has to send; the status counts, too. /tf has one count."""
    lab = Output(monkeypatch)
    changes: list[str] = []
    publishers = [lab.source(name, "wand") for name in ("lab", "hall")]
    for name in ("lab", "hall"):
        assert lab.output.watch_wanted(name, lambda name=name: changes.append(name))  # type: ignore[misc]
    for topic in (lab.output._tf, lab.output._diagnostics):
        await asyncio.to_thread(topic._on_matching, True)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert sorted(changes) == ["hall", "lab"]
        changes.clear()
    for publisher in publishers:
        publisher.publish(tools_frame((1, 2, 3)), stamp(), ALL)
    lab.sender.run()
    assert lab.node.sent == {"/tf": [1, 2]}


def test_tf_is_there_while_any_source_requests_tools(monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic on which nothing can come misleads; its subscribers must not keep a source at work."""
    lab = Output(monkeypatch)
    markers = parameters(markers=1)._replace(components=frozenset({ComponentType.MARKERS}))
    one, two = (lab.output.frame_publisher(name) for name in ("one", "two"))

    def use(name: str, given: ServerParameters) -> None:
        lab.output.publish_parameters(name, given)
        lab.sender.run()

    use("one", markers)
    assert "/tf" not in lab.node.open
    for name in ("one", "two"):
        use(name, parameters())  # without a description of tools, which frames may have nevertheless
        assert "/tf" in lab.node.open
    lab.match("/tf")
    assert [each.wants([ComponentType.TOOLS]) for each in (one, two)] == [True, True]
    use("one", markers)
    assert "/tf" in lab.node.open
    two.close()
    lab.output.withdraw("two")
    lab.sender.run()
    assert "/tf" not in lab.node.open
    assert not one.wants([ComponentType.TOOLS])


def test_only_equal_settings_are_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reload without changes disturbs no node."""
    one, same, other = (Output(monkeypatch, domain_id=domain_id).output for domain_id in (0, 0, 1))
    assert [one.is_configured_like(each) for each in (same, other)] == [True, False]


def test_a_router_that_does_not_read_is_a_problem_although_it_is_connected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """rmw_zenohd may hang for 60 s before Zenoh gives the connection up."""
    lab = Output(monkeypatch)
    for lab.sender.call_age_s in (0.0, 1.9):
        assert lab.output.health().connected
    lab.sender.call_age_s = 3.0
    assert names(lab.output.health().problem, "3 s")


def test_closing_ends_the_thread_and_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is queued afterwards but the end of the topics, whose memory Zenoh would keep."""
    lab = Output(monkeypatch, is_open=False)
    assert not lab.output.offer(lambda: None)
    lab.output.start()
    lab.output.close()
    lab.output.close()
    assert lab.sender.is_closed
    assert lab.router.events == ["start", "close", "close"]
    assert not lab.output.offer(lambda: None)
    lab.output.submit(lambda: None)
    assert lab.sender.calls == [lab.output._undeclare_all]


# With a real router -------------------------------------------------------------------------

_HASH = "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"


@pytest.mark.parametrize(
    ("settings", "token", "key"),
    [
        (
            {"domain_id": 7, "namespace": "", "distribution": "humble"},
            "MP/%/%/rtc3d_gateway/%lab%wand%pose/geometry_msgs::msg::dds_::PoseStamped_/"
            "TypeHashNotSupported/2::,10:,:,:,,",
            "7/lab/wand/pose/geometry_msgs::msg::dds_::PoseStamped_/TypeHashNotSupported",
        ),
        (
            {"namespace": "site/mocap", "reliability": "reliable", "depth": 5, "distribution": "rolling"},
            "MP/%/%site%mocap/rtc3d_gateway/%site%mocap%lab%wand%pose/"
            f"geometry_msgs::msg::dds_::PoseStamped_/{_HASH}/::,5:,:,:,,",
            f"0/site/mocap/lab/wand/pose/geometry_msgs::msg::dds_::PoseStamped_/{_HASH}",
        ),
    ],
)
def test_nodes_see_and_hear_topics_of_a_domain_namespace_distribution_and_qos(
    settings: dict[str, Any], token: str, key: str
) -> None:
    """Also those that subscribe for messages of transient local durability, as rmw_zenoh_cpp does."""
    with ros_lab(**settings) as lab:
        lab.open()
        publisher = lab.source(given=parameters(("wand",)))
        received: list[zenoh.Sample] = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=5)
        domain = settings.get("domain_id", 0)
        zenoh.ext.declare_advanced_subscriber(
            *(lab.peer, f"{domain}/**/pose/**", received.append), history=history, subscriber_detection=True
        )
        wait_until(lambda: publisher.wants(ALL))
        publisher.publish(tools_frame((1, 2, 3)), stamp(), ALL)
        wait_until(lambda: received)
        assert str(received[0].key_expr) == key
        [node] = [each for each in lab.tokens() if "/NN/" in each]
        [shown] = [each for each in lab.tokens() if "%wand%pose" in each]
        assert shown.startswith(node.partition("/0/0/NN")[0])
        assert shown.split("/", 5)[5] == token
        assert received[0].attachment is not None
        assert received[0].attachment.to_bytes()[17:] == gid_of(shown)
        lab.output.close()
        wait_until(lambda: not lab.tokens())
