"""Frames of a live source for its clients: passed on unchanged, cut, converted."""

from itertools import pairwise

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.client_session import MAX_FRAME_REQUESTS
from tests.unit.outputs.rtc3d.live_client import (
    TOOL_OUT_OF_VIEW,
    LiveSource,
    analog,
    body,
    component,
    event,
    markers,
)
from tests.unit.rtc3d_server.wire import COMMAND, ERROR


@pytest.mark.parametrize("command", ["StreamFrames", "StreamFrames AllFrames 3D 6D Analog Force Events"])
def test_a_body_is_passed_on_unchanged(command: str) -> None:
    source = LiveSource()
    client = source.client()
    client.send(command)
    unknown = bytes.fromhex("0000000c 00000063 01020304")
    sent = body(markers(7, 10_000), TOOL_OUT_OF_VIEW, event(7, 10_000, 3), unknown) + b"\n"
    source.arrive(sent)
    assert client.bodies == [sent]


def test_some_components_are_cut_out_and_keep_their_bytes() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames 6D Analog")
    source.arrive(body(markers(7, 10_000), TOOL_OUT_OF_VIEW, analog(70, 10_001), event(7, 10_000, 3)))
    unknown = bytes.fromhex("0000000c 00000063 01020304")
    source.arrive(body(TOOL_OUT_OF_VIEW, unknown))
    assert client.bodies == [body(TOOL_OUT_OF_VIEW, analog(70, 10_001)), body(TOOL_OUT_OF_VIEW)]


def test_a_repeated_component_is_passed_on_as_often() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames 3D")
    source.arrive(body(markers(7, 10_000), analog(70, 10_000), markers(8, 10_100)))
    assert client.bodies == [body(markers(7, 10_000), markers(8, 10_100))]


def test_components_that_the_gateway_skips_are_left_out() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames")
    source.arrive(body(markers(7, 10_000), event(7, 10_000, 3)), wanted=frozenset({ComponentType.EVENT}))
    assert client.bodies == [body(event(7, 10_000, 3))]


def test_a_client_gets_its_byte_order_whatever_the_server_sends() -> None:
    source = LiveSource()
    big, little = source.client(), source.client()
    little.send("SetByteOrder LittleEndian")
    for client in (big, little):
        client.send("StreamFrames")
    as_big = body(markers(7, 10_000), analog(70, 10_000))
    as_little = body(markers(7, 10_000, "little"), analog(70, 10_000, "little"), byte_order="little")
    source.arrive(as_big)
    source.arrive(as_little, byte_order="little")
    assert big.bodies == [as_big, as_big]
    assert little.bodies == [as_little, as_little]


def test_out_of_view_is_out_of_view_in_both_byte_orders() -> None:
    source = LiveSource()
    client = source.client()
    client.send("SetByteOrder LittleEndian")
    client.send("StreamFrames")
    source.arrive(body(TOOL_OUT_OF_VIEW))
    assert client.bodies[0].endswith(b"\xff" * 32)


def test_frames_without_the_components_of_a_client_are_none_for_it() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames FrequencyDivisor:2 3D")
    for number in range(1, 7):
        source.arrive(body(markers(number, 10_000 * number)))
        source.arrive(body(analog(number, 10_000 * number + 5000)))
    assert client.numbers() == [[1], [3], [5]]


def test_a_frequency_is_that_of_the_time_stamps() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames Frequency:60 3D")  # before the rate is known
    for number in range(1, 401):
        source.arrive(body(markers(number, 5_000 * number)))
    numbers = [frame[0] for frame in client.numbers()][20:]
    gaps = [later - earlier for earlier, later in pairwise(numbers)]
    assert set(gaps) == {3, 4}
    assert sum(gaps) / len(gaps) == pytest.approx(200 / 60, rel=0.02)


def test_the_current_frame_is_the_newest_and_each_is_sent_once() -> None:
    source = LiveSource()
    watching, client = source.client(), source.client()
    watching.send("StreamFrames")
    for number in (1, 2):
        source.arrive(body(markers(number, 10_000 * number)))
    client.send("SendCurrentFrame 3D")
    assert client.numbers() == [[2]]
    client.send("SendCurrentFrame 3D")
    assert client.numbers() == []
    source.arrive(body(markers(3, 30_000)))
    source.arrive(body(markers(4, 40_000)))
    assert client.numbers() == [[3]]


def test_requests_for_components_that_never_come_are_bounded() -> None:
    source = LiveSource()
    client = source.client()
    for _ in range(MAX_FRAME_REQUESTS):
        assert client.send("SendCurrentFrame Force")[0][0] == COMMAND
    ((kind, text),) = client.send("SendCurrentFrame Force")
    assert (kind, text) == (ERROR, b"Error-1000 requests for the current frame wait already")
    assert len(client.session.measurement_stopped()) == MAX_FRAME_REQUESTS


def test_what_was_before_a_pause_is_not_the_current_frame() -> None:
    source = LiveSource()
    client = source.client()
    client.send("SendCurrentFrame 3D")
    source.arrive(body(markers(1, 10_000)))
    assert client.numbers() == [[1]]
    source.scene.forget_frames()
    other = source.client()
    other.send("SendCurrentFrame 3D")
    assert other.numbers() == []
    source.arrive(body(markers(9, 90_000)))
    assert other.numbers() == [[9]]


def test_an_empty_frame_is_nothing() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames")
    source.arrive(body())
    assert client.bodies == []


def test_little_is_kept_of_large_frames() -> None:
    source = LiveSource()
    client = source.client()
    client.send("StreamFrames 3D")
    large = body(component(1, 1, 10_000, [(0, 0, 0, 0)] * 100_000))
    for _ in range(40):
        source.arrive(large)
        client.bodies.clear()
    assert sum(arrival.num_bytes for arrival in source.scene._arrivals.frames.since(0)) < 10_000_000
