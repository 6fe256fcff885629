import logging
from collections.abc import Iterator
from pathlib import Path

import lcm
import pytest

from gateway.errors import OutputError
from gateway.messages.topics import Topic
from gateway.outputs.lcm.connection import multicast_problem, open_lcm
from gateway.outputs.lcm.output import LcmOutput
from gateway.outputs.lcm.settings import LcmSettings
from tests.networks import add_multicast_route, lcm_url, remove_multicast_route
from tests.waiting import wait_until


def topic(*parts: str, source: str = "lab") -> Topic:
    return Topic(source, parts, "rtc3d.markers_t")


def probe(label: str) -> Topic:
    return topic("6d", label)


@pytest.fixture
def shared() -> lcm.LCM:
    return lcm.LCM("memq://")


@pytest.fixture
def output(shared: lcm.LCM) -> LcmOutput:
    output = LcmOutput(LcmSettings(url="memq://"), shared=shared)
    output.start()
    return output


# Channels ------------------------------------------------------------------------------------


def test_a_message_goes_to_its_channel_on_the_shared_object(output: LcmOutput, shared: lcm.LCM) -> None:
    received: list[tuple[str, bytes]] = []
    shared.subscribe(".*", lambda channel, message: received.append((channel, message)))
    output.publisher(topic("3d")).publish(b"message")
    assert shared.handle_timeout(10_000)
    assert received == [("MOCAP_LAB_3D", b"message")]


@pytest.mark.parametrize(
    ("parts", "channel"),
    [
        (("3d",), "Hall_HALL_2_3D"),
        (("status",), "Hall_HALL_2_STATUS"),
        (("6d", "Probe 1"), "Hall_HALL_2_6D_PROBE_1"),
    ],
)
def test_channels_have_the_prefix_as_it_is_and_the_rest_in_upper_case(
    parts: tuple[str, ...], channel: str
) -> None:
    output = LcmOutput(LcmSettings(prefix="Hall"))
    assert output.publisher(topic(*parts, source="hall-2")).channel == channel


def test_labels_that_look_alike_get_channels_of_their_own(output: LcmOutput) -> None:
    labels = ["Left foot", "left-foot", "LEFT FOOT", "膝", "足"]
    channels = [output.publisher(probe(label)).channel for label in labels]
    assert channels == [
        "MOCAP_LAB_6D_LEFT_FOOT",
        "MOCAP_LAB_6D_LEFT_FOOT_2",
        "MOCAP_LAB_6D_LEFT_FOOT_3",
        "MOCAP_LAB_6D__",
        "MOCAP_LAB_6D___2",
    ]


def test_long_labels_get_channels_of_their_own_that_lcm_takes(output: LcmOutput) -> None:
    publishers = [output.publisher(probe(100 * "x" + end)) for end in "abcdefghijkl"]
    channels = [publisher.channel for publisher in publishers]
    assert len(set(channels)) == 12
    assert {len(channel) for channel in channels} == {63}


def test_a_channel_given_up_is_free_and_one_in_use_is_not(output: LcmOutput) -> None:
    first, second = output.publisher(probe("a")), output.publisher(probe("A"))
    assert (first.channel, second.channel) == ("MOCAP_LAB_6D_A", "MOCAP_LAB_6D_A_2")
    first.close()
    again = output.publisher(probe("a"))
    first.close()
    another = output.publisher(probe("a"))
    assert (again.channel, another.channel) == ("MOCAP_LAB_6D_A", "MOCAP_LAB_6D_A_3")


# Opening -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        "nosuch://x",
        "udpm://239.255.76.67:99999",
        "udpm://not-an-address:7667",
        "file:///nosuch/folder/x?mode=w",
    ],
)
def test_a_url_that_lcm_refuses_is_told_with_the_url(url: str) -> None:
    output = LcmOutput(LcmSettings.model_construct(url=url))
    output.start()
    wait_until(lambda: output.health().problem.startswith("LCM does not open"))
    problem = output.health().problem
    assert problem.startswith(f"LCM does not open {url}: ")
    assert problem.endswith("check lcm.url")
    with pytest.raises(OutputError, match=r"check lcm\.url$") as caught:
        output.publisher(topic("3d")).publish(b"message")
    assert caught.value.cause == "not open"
    output.close()


def test_it_is_opened_again_once_it_can_be(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    log = tmp_path / "later" / "log"
    output = LcmOutput(LcmSettings(url=f"file://{log}?mode=w"))
    output.start()
    wait_until(lambda: bool(caplog.records))  # a thread opens it
    assert not output.health().connected
    log.parent.mkdir()

    def opened() -> bool:
        output.maintain()
        return output.health().connected

    wait_until(opened)
    output.publisher(topic("3d")).publish(b"message")
    output.close()
    # Closing frees the object, which writes what it still held.
    assert [(event.channel, event.data) for event in lcm.EventLog(str(log))] == [("MOCAP_LAB_3D", b"message")]
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]
    assert caplog.messages[1].startswith(f"lcm: sending messages to file://{log}?mode=w, after ")


@pytest.mark.parametrize("url", ["memq://", "file:///x?mode=w", "tcpq://127.0.0.1:7700", "nosuch://"])
def test_what_is_not_multicast_has_no_multicast_problem(url: str) -> None:
    assert multicast_problem(url) == ""


# Multicast -----------------------------------------------------------------------------------


@pytest.fixture
def _no_route() -> Iterator[None]:
    remove_multicast_route()
    yield
    add_multicast_route()


@pytest.mark.netns
@pytest.mark.usefixtures("_no_route")
@pytest.mark.parametrize("url", ["udpm://", "udpm://239.255.76.67:7667?ttl=1", "mpudpm://239.255.76.67:7667"])
def test_a_missing_multicast_route_is_told_with_the_remedy(url: str) -> None:
    problem = multicast_problem(url)
    assert url in problem
    assert "Network is unreachable" in problem
    assert "ip route add 224.0.0.0/4 dev INTERFACE" in problem
    with pytest.raises(OutputError) as caught:
        open_lcm(url)
    assert (str(caught.value), caught.value.cause) == (problem, "not open")


@pytest.mark.netns
def test_with_a_multicast_route_there_is_no_problem() -> None:
    assert multicast_problem("udpm://239.255.76.67:7667?ttl=1") == ""


@pytest.mark.netns
@pytest.mark.usefixtures("no_hold")
def test_a_route_lost_and_found_is_told_once_each(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.outputs")
    url = lcm_url()
    output = LcmOutput(LcmSettings(url=url))
    output.start()
    publisher = output.publisher(topic("3d"))
    caplog.clear()
    remove_multicast_route()
    try:
        for _ in range(3):
            with pytest.raises(OutputError, match="ip route add") as caught:
                publisher.publish(b"message")
            assert caught.value.cause == "send failed"
    finally:
        add_multicast_route()
    for _ in range(3):
        publisher.publish(b"message")
    output.close()
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]
    assert caplog.messages[0].startswith(f"lcm: no multicast to {url}: ")
    assert caplog.messages[1].startswith(f"lcm: sending messages to {url}, after ")
