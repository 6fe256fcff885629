"""An output on LCM in memory: its channels, and the parameters that subscribers receive."""

import asyncio
import logging
import threading
from collections import Counter
from types import SimpleNamespace
from unittest.mock import Mock

import lcm
import pytest

from gateway.messages.topics import Topic
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lcm import output as output_module
from gateway.outputs.lcm.output import REPEAT_S, LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from gateway.runtime.losses import Losses
from tests.support.clocks import Clock
from tests.support.statuses import amounts
from tests.unit.outputs.lcm.peer import XML, Lab, request


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
    assert not lab.requests.receiver._thread.is_alive()
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


# Parameters ----------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clocks of the queries; ``now_s`` is the time since the program started."""
    clock = Clock(100.0)
    monkeypatch.setattr(output_module, "time", SimpleNamespace(monotonic=clock))
    monkeypatch.setattr(output_module, "now_utime", lambda: round(1e6 * clock.now_s))
    return clock


async def test_parameters_are_published_now_and_every_few_seconds(lab: Lab, clock: Clock) -> None:
    lab.output.publish_parameters("lab", ServerParameters(XML + b"\0", 3, 4))
    for step_s in (0.0, REPEAT_S - 0.5, 0.5, 0.5, REPEAT_S):
        clock.now_s += step_s
        lab.output.maintain()
    lab.deliver()
    sent_s = [100.0, 100.0 + REPEAT_S, 100.5 + 2 * REPEAT_S]
    assert [message.utime for message in lab.parameters] == [round(1e6 * each) for each in sent_s]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    assert {message.capture_utime for message in lab.parameters} == {100_000_000}
    assert {(message.session, message.parameters_version) for message in lab.parameters} == {(3, 4)}
    assert {message.xml for message in lab.parameters} == {XML.decode()}


async def test_new_parameters_replace_the_old_ones_and_continue_the_sequence(lab: Lab, clock: Clock) -> None:
    lab.output.publish_parameters("lab", ServerParameters(b"<old/>", 1, 4))
    clock.now_s += 1.0
    lab.output.publish_parameters("lab", ServerParameters(b"<new/>", 2, 4))
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert [message.xml for message in lab.parameters] == ["<old/>", "<new/>", "<new/>"]
    assert [message.session for message in lab.parameters] == [1, 2, 2]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    assert [message.capture_utime for message in lab.parameters] == [100_000_000, 101_000_000, 101_000_000]


async def test_parameters_of_a_withdrawn_source_are_not_published_again(lab: Lab, clock: Clock) -> None:
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.output.withdraw("lab")
    lab.output.withdraw("lab")
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert len(lab.parameters) == 1


async def test_an_output_without_queries_has_no_results() -> None:
    output = LcmOutput(LcmSettings(url="memq://"), lcm.LCM("memq://"))
    output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    output.maintain()
    assert output.query_results is None
    await output.stop_queries()


async def test_long_parameters_are_sent_by_a_thread(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """Short ones must not overtake them: late subscribers would keep the old names."""
    monkeypatch.setattr(output_module, "LONG_REPLY_BYTES", 10)
    may_send = threading.Event()
    lab.requests.replies.long_sender.submit(may_send.wait)
    sent = lab.output.publish_parameters("lab", ServerParameters(b"<long enough/>", 3, 4))
    short = lab.output.publish_parameters("lab", ServerParameters(b"<a/>", 3, 5))
    may_send.set()
    assert sent is not None
    assert short is not None
    await asyncio.gather(sent, short)
    again = lab.output.publish_parameters("lab", ServerParameters(b"<longer than that/>", 3, 6))
    assert again is not None
    await again
    lab.deliver()
    assert [message.xml for message in lab.parameters] == ["<a/>", "<a/>", "<longer than that/>"]
    assert [message.sequence for message in lab.parameters] == [0, 1, 2]
    lab.send(request(1))
    [reply] = await lab.receive()
    assert reply.xml == XML.decode()


@pytest.mark.parametrize(
    ("xml", "text"),
    [
        ("<µm/>".encode(), "<µm/>"),
        ("<µm/>".encode("latin-1"), "<µm/>"),
        (b"<a/>\0\0", "<a/>"),
        (b"\0<a/>\0b", "\0<a/>\0b"),
    ],
    ids=["UTF-8", "Latin-1", "NULs at the end", "other NULs"],
)
async def test_xml_is_sent_as_text_without_the_nuls_at_its_end(lab: Lab, xml: bytes, text: str) -> None:
    lab.service.reply = ServerParameters(xml, 1, 4)
    lab.send(request())
    [reply] = await lab.receive()
    assert reply.xml == text


async def test_parameters_published_before_lcm_opens_follow_later(clock: Clock) -> None:
    lab = Lab()
    lab.output.publish_parameters("lab", ServerParameters(XML, 3, 4))
    lab.open()
    clock.now_s += REPEAT_S
    lab.output.maintain()
    lab.deliver()
    assert [message.xml for message in lab.parameters] == [XML.decode()]
    await lab.output.stop_queries()
    lab.output.close()
