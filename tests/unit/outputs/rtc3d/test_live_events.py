"""Events of a live source for its clients: none is lost at a low rate, and none waits for others."""

import pytest

from gateway.outputs.rtc3d.live_frames import KEPT_EVENTS
from tests.unit.outputs.rtc3d.live_client import (
    FAST,
    SLOW,
    TOOL_OUT_OF_VIEW,
    LiveSource,
    analog,
    body,
    event,
    markers,
    pair,
    play,
    streaming,
)
from tests.unit.rtc3d_server.wire import EVENT, MARKERS


def test_no_event_is_lost_at_a_low_rate() -> None:
    source, client = streaming("StreamFrames FrequencyDivisor:4 3D Events")
    for number in range(1, 10):
        source.arrive(pair(number))
    frames = client.take()
    assert [frame[0].frame_number for frame in frames] == [1, 5, 9]
    events = [each for frame in frames for each in frame if each.type == EVENT]
    assert [item[:2] for each in events for item in each.items] == [
        (number, 10_000 * number) for number in range(1, 10)
    ]
    assert [(each.frame_number, each.timestamp_us) for each in events] == [
        (1, 10_000), (5, 50_000), (9, 90_000),
    ]  # fmt: skip


def test_a_client_that_lacks_events_is_counted() -> None:
    source = LiveSource()
    slow, other = source.client(), source.client()
    slow.send("StreamFrames FrequencyDivisor:5000 3D Events")
    other.send("StreamFrames 3D Events")
    for number in range(1, 5002):
        source.arrive(pair(number))
    _, frame = slow.take()
    assert [item[0] for item in frame[1].items] == list(range(5002 - KEPT_EVENTS, 5002))
    assert (slow.session.frames_without_events, other.session.frames_without_events) == (1, 0)
    for number in range(5002, 10_002):
        events = [event(number, 10_000 * number, number)] if number % 10 == 0 else []
        source.arrive(body(markers(number, 10_000 * number), *events))
    assert [len(frame[1].items) for frame in slow.take()] == [500]
    assert slow.session.frames_without_events == 1


def test_events_without_other_components_are_frames_of_their_own() -> None:
    source = LiveSource()
    client, other = source.client(), source.client()
    client.send("StreamFrames Events")
    other.send("StreamFrames Events 6D")
    sent = [body(event(number, 10_000 * number, number)) for number in range(3)]
    for each in sent:
        source.arrive(each)
    source.arrive(body(markers(1, 40_000), event(9, 40_000, 9)))
    assert client.bodies == [*sent, body(event(9, 40_000, 9))]
    assert other.bodies == client.bodies


@pytest.mark.parametrize("rate", ["FrequencyDivisor:5", "Frequency:20"])
def test_an_event_does_not_wait_for_others(rate: str) -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=False)
    client = source.client()
    client.send(f"StreamFrames {rate} Events")
    for number in range(4, 50):
        events = [event(number, 10_000 * number, number)] if number in {7, 8, 22} else []
        source.arrive(body(markers(number, 10_000 * number), *events))
        source.arrive(body(analog(number, 10_000 * number)), FAST)
        if number == 13:
            assert [[item[0] for item in each[0].items] for each in client.take()] == [[7, 8]]
    assert [[item[0] for item in each[0].items] for each in client.take()] == [[22]]


def test_an_event_on_a_faster_stream_does_not_wait_for_the_slower_one() -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=False)
    client = source.client()
    client.send("StreamFrames Events")
    source.arrive(body(analog(40, 40_000), event(40, 40_000, 9)), FAST)
    assert client.bodies == [body(event(40, 40_000, 9))]


def test_a_request_for_events_does_not_wait_for_one() -> None:
    source, client = streaming("SendCurrentFrame Events")
    source.arrive(body(markers(1, 10_000)))
    assert client.bodies == [body()]
    client.send("SendCurrentFrame Events")
    source.arrive(body(markers(2, 20_000), event(2, 20_000, 3)))
    assert client.bodies == [body(), body(event(2, 20_000, 3))]


def test_a_request_for_components_that_do_not_come_gets_an_empty_frame() -> None:
    source = LiveSource()
    play(source, 1, 3, fast_first=False)
    client, streaming = source.client(), source.client()
    streaming.send("StreamFrames 6D")
    source.arrive(body(markers(4, 40_000)))
    client.send("SendCurrentFrame 6D")
    assert client.bodies == [body()]
    assert streaming.bodies == []
    source.arrive(body(markers(5, 50_000), TOOL_OUT_OF_VIEW))
    client.send("SendCurrentFrame 6D")
    assert client.bodies == [body(), body(TOOL_OUT_OF_VIEW)]
    assert streaming.bodies == [body(TOOL_OUT_OF_VIEW)]


def test_a_request_for_components_that_a_new_server_lacks_gets_an_empty_frame() -> None:
    source = LiveSource()
    client = source.client()
    for number in range(1, 4):
        source.arrive(body(markers(number, 10_000 * number), TOOL_OUT_OF_VIEW))
        source.wait(10_000)
    source.scene.stop()
    client.send("SendCurrentFrame 6D")
    for number in range(1, 4):
        source.arrive(body(markers(number, 10_000 * number)), SLOW + 2)
        source.wait(1_000_000)
    assert client.bodies == [body()]


def test_events_in_frames_of_their_own_do_not_shift_a_divisor() -> None:
    source, client = streaming("StreamFrames FrequencyDivisor:2 3D Events")
    for number in range(1, 7):
        source.arrive(body(markers(number, 10_000 * number)))
        source.arrive(body(event(number, 10_000 * number, number)))
    frames = client.take()
    assert [[each.frame_number for each in frame if each.type == MARKERS] for frame in frames] == [
        [1], [3], [5],
    ]  # fmt: skip
    events = [each for frame in frames for each in frame if each.type == EVENT]
    assert [item[0] for each in events for item in each.items] == [1, 2, 3, 4]
