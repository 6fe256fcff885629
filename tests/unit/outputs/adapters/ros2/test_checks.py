"""The doctor's checks for ROS 2, with a router, without one, and with nodes."""

from collections.abc import Iterator
from typing import Any

import pytest

from gateway.messages.ros2.encode import NO_HASH, POSE_STAMPED
from gateway.outputs.adapters.ros2.checks import check_ros2, leaves_host
from gateway.outputs.adapters.ros2.settings import ROS2, Ros2Settings
from gateway.outputs.findings import Result
from tests.support.errors import names
from tests.support.networks import free_endpoint
from tests.support.ros_lab import RosLab, ros_lab
from tests.support.waiting import wait_until


@pytest.fixture
def lab() -> Iterator[RosLab]:
    with ros_lab(domain_id=3) as lab:
        yield lab


def findings(settings: Ros2Settings, seconds: float = 1.0) -> dict[str, tuple[Result, str]]:
    found = check_ros2(settings, ["lab"], [], seconds)
    assert [each.check for each in found] == list(ROS2.checks)
    return {each.check: (each.result, each.found) for each in found}


def test_without_a_router_the_remedy_is_to_start_it() -> None:
    endpoint = free_endpoint()
    [router, gateway, nodes, types] = check_ros2(Ros2Settings(connect=endpoint), ["lab"], [], 0.5)
    assert router.result is Result.FAILING
    assert endpoint in router.found
    assert "rmw_zenohd" in router.remedy
    assert {gateway.result, nodes.result, types.result} == {Result.NOT_TESTED}


def test_a_router_without_nodes_and_then_with_some(lab: RosLab) -> None:
    found = findings(lab.settings)
    assert found["router"][0] is Result.PASSING
    assert found["gateway"][0] is Result.NOT_TESTED
    assert names(found["gateway"][1], "/mocap/rtc3d_gateway", "domain 3")
    assert found["nodes"][0] is Result.NOTE
    assert names(found["nodes"][1], "domain 3")
    lab.open()
    keys = [f"@ros2_lv/3/abc/{number}/{number}/NN/%/%arm/node_{number}" for number in range(10)]
    tokens = [
        lab.peer.liveliness().declare_token(key) for key in (*keys, "@ros2_lv/4/abc/0/0/NN/%/%/elsewhere")
    ]
    wait_until(lambda: len(lab.tokens()) == 13)
    found = findings(lab.settings)
    assert found["gateway"][0] is Result.PASSING
    assert names(found["gateway"][1], "/mocap/rtc3d_gateway", "domain 3")
    named = ", ".join(f"/arm/node_{number}" for number in range(8))
    assert found["nodes"] == (Result.PASSING, f"visible in domain 3: {named} and 2 more")
    del tokens


@pytest.mark.parametrize(
    ("type_hash", "distribution", "remedy"),
    [
        (POSE_STAMPED.type_hash, "jazzy", ""),
        ("TypeHashNotSupported", "humble", ""),
        ("TypeHashNotSupported", "jazzy", "humble"),
        (POSE_STAMPED.type_hash, "humble", "jazzy"),
    ],
)
def test_nodes_of_another_distribution_get_nothing(
    lab: RosLab, type_hash: str, distribution: Any, remedy: str
) -> None:
    subscription = f"%mocap%lab%wand%pose/{POSE_STAMPED.dds_name}/{type_hash}/2::,10:,:,:,,"
    others = [f"@ros2_lv/3/abc/0/2/MS/%/%/rviz/%x/some::Type_/{NO_HASH}/::,10:,:,:,,", "@ros2_lv/3/a/b"]
    tokens = [f"@ros2_lv/3/abc/0/1/MS/%/%arm/hand/{subscription}", *others]
    declared = [lab.peer.liveliness().declare_token(token) for token in tokens]
    wait_until(lambda: len(lab.tokens()) == 3)
    settings = lab.settings.model_copy(update={"distribution": distribution})
    [*_, types] = check_ros2(settings, ["lab"], [], 1.0)
    assert types.result is (Result.WARNING if remedy else Result.PASSING)
    assert remedy in types.remedy
    assert names(types.found, "/arm/hand", "/mocap/lab/wand/pose") == bool(remedy)
    for token in declared:
        token.undeclare()


@pytest.mark.parametrize(
    ("connect", "leaves"),
    [("tcp/127.0.0.1:7447", False), ("tcp/localhost:7447", False), ("tcp/192.0.2.5:7447", True)],
)
def test_a_router_on_another_computer_means_that_messages_leave_this_one(connect: str, leaves: bool) -> None:
    assert leaves_host(Ros2Settings(connect=connect)) is leaves
