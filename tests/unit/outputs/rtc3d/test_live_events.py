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
    event_of,
    frame_of_markers,
)
from tests.unit.rtc3d_server.wire import EVENT, MARKERS, WireComponent


def test_no_event_is_lost_at_a_low_rate() -> None:
    source = LiveSource()
    client = source.client("StreamFrames FrequencyDivisor:4 3D Events")
    for number in range(1, 10):
        source.arrive(frame_of_markers(number, event_of(number)))
    frames = client.take()
    assert [frame[0].frame_number for frame in frames] == [1, 5, 9]
    items = [(number, 10_000 * number, -1, -1, -1) for number in range(1, 10)]
    expected = [(1, items[:1]), (5, items[1:5]), (9, items[5:])]
    assert [frame[1] for frame in frames] == [
        WireComponent(EVENT, number, 10_000 * number, found) for number, found in expected
    ]


def test_a_client_that_lacks_events_is_counted() -> None:
    source = LiveSource()
    slow = source.client("StreamFrames FrequencyDivisor:5000 3D Events")
    other = source.client("StreamFrames 3D Events")
    for number in range(1, 5002):
        source.arrive(frame_of_markers(number, event_of(number)))
    assert slow.event_ids()[1] == list(range(5002 - KEPT_EVENTS, 5002))
    assert (slow.session.frames_without_events, other.session.frames_without_events) == (1, 0)
    for number in range(5002, 10_002):
        source.arrive(frame_of_markers(number, *([event_of(number)] if number % 10 == 0 else [])))
    assert [len(ids) for ids in slow.event_ids()] == [500]
    assert slow.session.frames_without_events == 1


def test_events_without_other_components_are_frames_of_their_own() -> None:
    source = LiveSource()
    client, other = source.client("StreamFrames Events"), source.client("StreamFrames Events 6D")
    sent = [body(event_of(number)) for number in range(3)]
    for each in sent:
        source.arrive(each)
    source.arrive(frame_of_markers(4, event_of(4)))
    assert client.bodies == other.bodies == [*sent, body(event_of(4))]


@pytest.mark.parametrize("rate", ["FrequencyDivisor:5", "Frequency:20"])
def test_an_event_does_not_wait_for_others(rate: str) -> None:
    source = LiveSource(played=3)
    client = source.client(f"StreamFrames {rate} Events")
    for number in range(4, 50):
        source.arrive(frame_of_markers(number, *([event_of(number)] if number in {7, 8, 22} else [])))
        source.arrive(body(analog(number, 10_000 * number)), FAST)
        assert number != 13 or client.event_ids() == [[7, 8]]
    assert client.event_ids() == [[22]]


def test_an_event_on_a_faster_stream_does_not_wait_for_the_slower_one() -> None:
    source = LiveSource(played=3)
    client = source.client("StreamFrames Events")
    source.arrive(body(analog(40, 40_000), event(40, 40_000, 9)), FAST)
    assert client.bodies == [body(event(40, 40_000, 9))]


def test_a_request_for_events_does_not_wait_for_one() -> None:
    source = LiveSource()
    client = source.client("SendCurrentFrame Events")
    source.arrive(frame_of_markers(1))
    assert client.bodies == [body()]
    client.send("SendCurrentFrame Events")
    source.arrive(frame_of_markers(2, event_of(2)))
    assert client.bodies == [body(), body(event_of(2))]


def test_a_request_for_components_that_do_not_come_gets_an_empty_frame() -> None:
    source = LiveSource(played=3)
    client, streaming = source.client(), source.client("StreamFrames 6D")
    source.arrive(frame_of_markers(4))
    client.send("SendCurrentFrame 6D")
    assert (client.bodies, streaming.bodies) == ([body()], [])
    source.arrive(frame_of_markers(5, TOOL_OUT_OF_VIEW))
    client.send("SendCurrentFrame 6D")
    tool = body(TOOL_OUT_OF_VIEW)
    assert (client.bodies, streaming.bodies) == ([body(), tool], [tool])


def test_a_request_for_components_that_a_new_server_lacks_gets_an_empty_frame() -> None:
    source = LiveSource()
    client = source.client()
    for number in range(1, 4):
        source.arrive(frame_of_markers(number, TOOL_OUT_OF_VIEW))
        source.wait(10_000)
    source.scene.stop()
    client.send("SendCurrentFrame 6D")
    for number in range(1, 4):
        source.arrive(frame_of_markers(number), SLOW + 2)
        source.wait(1_000_000)
    assert client.bodies == [body()]


def test_events_in_frames_of_their_own_do_not_shift_a_divisor() -> None:
    source = LiveSource()
    client = source.client("StreamFrames FrequencyDivisor:2 3D Events")
    for number in range(1, 7):
        source.arrive(frame_of_markers(number))
        source.arrive(body(event_of(number)))
    frames = client.take()
    numbers = [[each.frame_number for each in frame if each.type == MARKERS] for frame in frames]
    assert numbers == [[1], [3], [5]]
    assert [item[0] for frame in frames for each in frame if each.type == EVENT for item in each.items] == [
        1,
        2,
        3,
        4,
    ]
