"""Frames of a live source for its clients: passed on unchanged, cut, converted, and joined by time stamp."""

from itertools import pairwise

import pytest

from gateway.outputs.rtc3d.live_frames import WAIT_US
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.client_session import MAX_FRAME_REQUESTS
from tests.unit.outputs.rtc3d.live_client import (
    FAST,
    SLOW,
    TOOL_OUT_OF_VIEW,
    LiveSource,
    analog,
    body,
    component,
    event,
    markers,
    play,
    streaming,
)
from tests.unit.rtc3d_server.wire import COMMAND, ERROR

UNKNOWN = bytes.fromhex("0000000c 00000063 01020304")
each_order = pytest.mark.parametrize("fast_first", [False, True])


@pytest.mark.parametrize("command", ["StreamFrames", "StreamFrames AllFrames 3D 6D Analog Force Events"])
def test_a_body_is_passed_on_unchanged(command: str) -> None:
    source = LiveSource()
    client = source.client()
    client.send(command)
    sent = body(markers(7, 10_000), TOOL_OUT_OF_VIEW, event(7, 10_000, 3), UNKNOWN) + b"\n"
    source.arrive(sent)
    assert client.bodies == [sent]


def test_some_components_are_cut_out_and_keep_their_bytes() -> None:
    source, client = streaming("StreamFrames 6D Analog")
    source.arrive(body(markers(7, 10_000), TOOL_OUT_OF_VIEW, analog(70, 10_001), event(7, 10_000, 3)))
    source.arrive(body(TOOL_OUT_OF_VIEW, UNKNOWN))
    assert client.bodies == [body(TOOL_OUT_OF_VIEW, analog(70, 10_001)), body(TOOL_OUT_OF_VIEW)]


def test_a_repeated_component_is_passed_on_as_often() -> None:
    source, client = streaming("StreamFrames 3D")
    source.arrive(body(markers(7, 10_000), analog(70, 10_000), markers(8, 10_100)))
    assert client.bodies == [body(markers(7, 10_000), markers(8, 10_100))]


def test_components_that_the_gateway_skips_are_left_out() -> None:
    source, client = streaming("StreamFrames")
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
    source, client = streaming("SetByteOrder LittleEndian")
    client.send("StreamFrames")
    source.arrive(body(TOOL_OUT_OF_VIEW))
    assert client.bodies[0].endswith(b"\xff" * 32)


def test_frames_without_the_components_of_a_client_are_none_for_it() -> None:
    source, client = streaming("StreamFrames FrequencyDivisor:2 3D")
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
    source, client = streaming("SendCurrentFrame 3D")
    source.arrive(body(markers(1, 10_000)))
    assert client.numbers() == [[1]]
    source.scene.forget_frames()
    other = source.client()
    other.send("SendCurrentFrame 3D")
    assert other.numbers() == []
    source.arrive(body(markers(9, 90_000)))
    assert other.numbers() == [[9]]


def test_an_empty_frame_is_nothing() -> None:
    source, client = streaming("StreamFrames")
    source.arrive(body())
    assert client.bodies == []


def test_little_is_kept_of_large_frames() -> None:
    source, client = streaming("StreamFrames 3D")
    large = body(component(1, 1, 10_000, [(0, 0, 0, 0)] * 100_000))
    for _ in range(40):
        source.arrive(large)
        client.bodies.clear()
    assert sum(arrival.num_bytes for arrival in source.scene._arrivals.frames.since(0)) < 10_000_000


# Joined frames ------------------------------------------------------------------------------


@each_order
def test_components_of_two_streams_are_joined_by_time_stamp(fast_first: bool) -> None:
    source = LiveSource()
    client = source.client()
    play(source, 1, 3, fast_first=fast_first)
    client.send("StreamFrames 3D Analog")
    play(source, 4, 20, fast_first=fast_first)
    assert client.numbers() == [[number, 10 * number] for number in range(4, 21)]


def test_a_joined_frame_has_the_components_as_they_came() -> None:
    source = LiveSource()
    client = source.client()
    play(source, 1, 3, fast_first=False)
    client.send("StreamFrames")
    play(source, 4, 4, fast_first=False)
    assert client.bodies == [body(markers(4, 40_000), analog(40, 40_000), event(4, 40_000, 4))]


def test_a_client_of_one_stream_gets_every_frame_of_it() -> None:
    source, client = streaming("StreamFrames Analog")
    play(source, 1, 5, fast_first=False)
    assert client.numbers() == [[number] for number in range(10, 60)]


def test_at_first_frames_wait_until_the_announced_components_are_known() -> None:
    source = LiveSource(is_new=True)
    source.scene._announced_hz = {ComponentType.MARKERS: 100.0, ComponentType.ANALOG: 1000.0}
    client = source.client()
    client.send("StreamFrames 3D Analog")
    for step in range(5):
        source.arrive(body(analog(5 + step, 5000 + 1000 * step)), FAST)
        source.wait(1000)
    assert client.take() == []
    play(source, 1, 3, fast_first=False)
    assert client.numbers() == [[1, 10], [2, 20], [3, 30]]


def test_at_first_frames_wait_until_the_rates_are_known() -> None:
    source, client = streaming("StreamFrames 3D Analog", is_new=True)
    play(source, 1, 20, fast_first=True)
    assert client.numbers() == [[number, 10 * number] for number in range(1, 21)]


def test_the_second_frame_of_a_new_source_waits_for_its_sample() -> None:
    source = LiveSource(is_new=True)
    source.scene._announced_hz = {ComponentType.MARKERS: 100.0, ComponentType.ANALOG: 100.0}
    client = source.client()
    client.send("StreamFrames 3D Analog")
    for number in range(1, 4):
        source.arrive(body(markers(number, 10_000 * number)))
        source.wait(1000)
        source.arrive(body(analog(number, 10_000 * number)), FAST)
        source.wait(9000)
    assert client.numbers() == [[1, 1], [2, 2], [3, 3]]


def test_components_that_are_announced_and_never_come_are_not_waited_for_long() -> None:
    source = LiveSource(is_new=True)
    source.scene._announced_hz = {ComponentType.MARKERS: 100.0, ComponentType.ANALOG: 1000.0}
    client = source.client()
    client.send("StreamFrames 3D Analog")
    for step in range(250):
        source.arrive(body(analog(step, 1000 * step)), FAST)
        source.wait(1000)
    assert client.take() == []
    source.wait(50_000)
    assert client.numbers() == [[step] for step in range(250)]


def test_a_client_that_asks_between_two_samples_gets_complete_frames_only() -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=True)
    source.scene.forget_frames()
    client = source.client()
    source.arrive(body(analog(40, 40_000)), FAST)
    source.scene.forget_frames()
    client.send("StreamFrames 3D Analog")
    source.arrive(body(markers(4, 40_000)))
    for step in range(1, 10):
        source.arrive(body(analog(40 + step, 40_000 + 1000 * step)), FAST)
    play(source, 5, 6, fast_first=True)
    assert client.numbers() == [[5, 50], [6, 60]]


@pytest.mark.parametrize("command", ["StreamFrames 3D Analog", "SendCurrentFrame 3D Analog"])
@pytest.mark.parametrize("pause_us", [300_000, 5_000_000])
@each_order
def test_the_first_frames_after_a_pause_are_complete(command: str, pause_us: int, fast_first: bool) -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=True)
    source.scene.forget_frames()  # nobody asks for any
    source.wait(pause_us)
    client = source.client()
    client.send(command)
    base_us = 40_000 + pause_us
    for step in range(5, 10):
        source.arrive(body(analog(step, base_us - 10_000 + 1000 * step)), FAST)
        source.wait(1000)
    play(source, 0, 2, fast_first=fast_first, base_us=base_us)
    numbers = client.numbers()
    assert numbers
    assert all(len(frame) == 2 for frame in numbers)


@each_order
def test_a_measurement_that_begins_late_begins_with_complete_frames(fast_first: bool) -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=fast_first)
    source.scene.stop()
    client = source.client()
    client.send("StreamFrames 3D Analog")
    source.wait(1_500_000)
    source.arrive(body(analog(9, 9_000)), FAST)
    play(source, 1, 3, fast_first=fast_first)
    numbers = client.numbers()
    assert numbers[-2:] == [[2, 20], [3, 30]]
    assert all(len(frame) == 2 for frame in numbers)


def test_requests_with_pauses_between_them_do_not_change_the_rate() -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=False)
    client = source.client()
    for number in range(100, 300, 10):
        source.scene.forget_frames()
        client.send("SendCurrentFrame")
        source.wait(500_000)
        play(source, number, number, fast_first=False)
    assert all(len(frame) == 3 for frame in client.take())
    assert source.scene.frames(()).rate == 100


def test_a_frame_waits_for_the_faster_stream_and_not_for_ever() -> None:
    source, client = streaming("StreamFrames 3D Analog")
    play(source, 1, 5, fast_first=False)
    client.take()
    source.arrive(body(markers(6, 60_000)))
    source.wait(WAIT_US - 1)
    assert client.take() == []
    source.wait(1)
    assert client.numbers() == [[6, 59]]
    source.wait(1_000_000)
    source.arrive(body(markers(7, 70_000)))
    assert client.numbers() == [[7]]


def test_while_the_slower_stream_has_no_frames_the_faster_one_sets_the_rate() -> None:
    source, client = streaming("StreamFrames 3D Analog")
    play(source, 1, 5, fast_first=False)
    client.take()
    source.wait(1_100_000)
    source.arrive(body(analog(2000, 2_000_000)), FAST)
    assert client.numbers() == [[2000]]
    play(source, 300, 304, fast_first=False)
    assert client.numbers()[-4:] == [[number, 10 * number] for number in range(301, 305)]


@each_order
def test_a_new_measurement_is_joined_from_its_first_frames(fast_first: bool) -> None:
    source, client = streaming("StreamFrames 3D Analog")
    play(source, 1000, 1010, fast_first=False)
    client.take()
    play(source, 1, 5, fast_first=fast_first)
    assert client.numbers()[1:] == [[number, 10 * number] for number in range(2, 6)]


def test_a_connection_that_is_made_again_continues_the_joined_frames() -> None:
    source, client = streaming("StreamFrames 3D Analog")
    play(source, 1, 5, fast_first=False)
    client.take()
    for number in range(6, 10):
        source.arrive(body(markers(number, 10_000 * number)), SLOW + 2)
        source.arrive(body(analog(10 * number, 10_000 * number)), FAST)
        source.wait(10_000)
    assert client.numbers() == [[number, 10 * number] for number in range(6, 10)]


def test_time_stamps_that_are_no_times_join_the_newest_without_waiting() -> None:
    source, client = streaming("StreamFrames 3D Analog")
    for number in range(1, 10):
        source.arrive(body(analog(number, 0)), FAST)
        source.arrive(body(markers(number, 0)), SLOW)
    assert client.numbers()[-6:] == [[number, number] for number in range(4, 10)]
