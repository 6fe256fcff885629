"""The channels of an output on LCM."""

import logging
from collections import Counter
from unittest.mock import Mock

import pytest

from gateway.logs.losses import Losses
from gateway.messages.topics import Topic
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from tests.losses import amounts
from tests.unit.outputs.lcm.peer import Lab


@pytest.fixture
def output() -> LcmOutput:
    return LcmOutput(LcmSettings(url="memq://"))


def probe(label: str) -> Topic:
    return Topic("lab", ("6d", label), "rtc3d.tool_pose_t")


def test_channels_have_the_prefix_as_it_is_and_the_rest_in_upper_case() -> None:
    output = LcmOutput(LcmSettings(prefix="Hall"))
    channel = output.publisher(Topic("hall-2", ("6d", "Probe 1"), "rtc3d.tool_pose_t")).channel
    assert channel == "Hall_HALL_2_6D_PROBE_1"


def test_a_channel_given_up_is_free_and_one_in_use_is_not(output: LcmOutput) -> None:
    first, second = output.publisher(probe("a")), output.publisher(probe("A"))
    assert (first.channel, second.channel) == ("MOCAP_LAB_6D_A", "MOCAP_LAB_6D_A_2")
    first.close()
    again = output.publisher(probe("a"))
    first.close()
    another = output.publisher(probe("a"))
    assert (again.channel, another.channel) == ("MOCAP_LAB_6D_A", "MOCAP_LAB_6D_A_3")


async def test_without_queries_nothing_is_received() -> None:
    lab = Lab(queries=False)
    lab.open()
    assert not lab.queries._receiver._thread.is_alive()
    await lab.output.stop_queries()


def test_labels_that_look_alike_or_are_too_long_for_lcm_get_channels_of_their_own(output: LcmOutput) -> None:
    labels = ["Left foot", "left-foot", "LEFT FOOT", "膝", "足"]
    channels = [output.publisher(probe(label)).channel for label in labels]
    assert channels == [
        f"MOCAP_LAB_6D_{end}" for end in ("LEFT_FOOT", "LEFT_FOOT_2", "LEFT_FOOT_3", "_", "__2")
    ]
    long = [output.publisher(probe(100 * "x" + end)).channel for end in "abcdefghijkl"]
    assert (len(set(long)), {len(channel) for channel in long}) == (12, {63})


def test_what_a_peer_has_not_taken_at_the_end_is_counted(
    output: LcmOutput, monkeypatch: pytest.MonkeyPatch
) -> None:
    """160 of 300 messages were lost over tcpq, and all counted as sent."""
    losses = Losses(logging.getLogger(__name__), "lab to lcm")
    output.count_losses("lab", losses)
    monkeypatch.setattr(output, "_sender", Mock(close=lambda: Counter(lab=160)))
    output.close()
    assert amounts(losses.report()) == {"closed": (160, 0)}


@pytest.mark.parametrize(
    ("url", "queries_url"),
    [
        ("udpm://239.255.76.68:7000?ttl=1", "udpm://239.255.76.68:7001?ttl=1"),
        ("udpm://", "udpm://239.255.76.67:7668"),
        ("udpm://239.255.76.68:65535", "udpm://239.255.76.68:65534"),
        ("mpudpm://239.255.76.68:7000", "mpudpm://239.255.76.68:7000"),
        ("tcpq://127.0.0.1:7700", "tcpq://127.0.0.1:7700"),
    ],
)
def test_requests_have_a_multicast_port_of_their_own(
    url: str, queries_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert LcmSettings(url=url).effective_queries_url == queries_url
    monkeypatch.setenv("LCM_DEFAULT_URL", url)
    assert LcmSettings().effective_queries_url == queries_url
