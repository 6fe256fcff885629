"""Which frames one client gets from the RT server, and when: streams, single frames, events, measurements."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.rtc3d_server.scripted_client import ScriptedClient
from tests.unit.rtc3d_server.wire import (
    ANALOG,
    COMMAND,
    ERROR,
    EVENT,
    MARKERS,
    NO_DATA,
    TOOLS,
    WireComponent,
    packets_in,
)

SECOND_US = 1_000_000


@pytest.fixture
def client() -> ScriptedClient:
    return ScriptedClient()


# Streams ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sent", ["StreamFrames", "StreamFrames AllFrames", "StreamFrames All"])
def test_a_stream_has_all_components_in_every_frame_by_default(client: ScriptedClient, sent: str) -> None:
    client.send(sent)
    frames = client.frames_until(60_000)
    assert [[component.type for component in frame] for frame in frames] == [[MARKERS, TOOLS, ANALOG]] * 7
    numbers = [(frame[0].frame_number, frame[2].frame_number, frame[2].timestamp_us) for frame in frames]
    assert numbers == [(k + 1, 10 * k + 1, 10_000 * k) for k in range(7)]


@pytest.mark.parametrize(
    ("requested", "until_us", "numbers"),
    [
        ("Analog", 99_999, list(range(1, 101))),
        ("FrequencyDivisor:4 3D", 200_000, [1, 5, 9, 13, 17, 21]),
        ("Frequency:60 3D", 109_999, [1, 3, 5, 6, 8, 10, 11]),
        *((f"Frequency:{hz} 3D Analog", 50_000, [1, 2, 3, 4, 5, 6]) for hz in ("100", "100.5", "2000")),
        ("Force", 50_000, []),  # which the scene lacks
    ],
)
def test_a_stream_has_its_rate(
    client: ScriptedClient, requested: str, until_us: int, numbers: list[int]
) -> None:
    """§5.3.5: the slowest component of a request is the limit."""
    client.send(f"StreamFrames {requested}")
    assert client.numbers_until(until_us) == numbers


@given(rate_hz=st.integers(1, 2000), frequency_hz=st.floats(0.1, 2500), start=st.integers(0, 10**6))
def test_any_frequency_is_exact_and_has_even_gaps(rate_hz: int, frequency_hz: float, start: int) -> None:
    client = ScriptedClient(rate_hz)
    client.elapsed_us = start
    text = f"{frequency_hz:.6f}"
    client.send(f"StreamFrames Frequency:{text} 3D")
    stride = max(1.0, rate_hz / float(text))
    numbers = []
    for _ in range(200):
        assert client.session.due_us is not None
        numbers += client.numbers_until(client.session.due_us)
    assert {after - before for before, after in pairwise(numbers)} <= {math.floor(stride), math.ceil(stride)}
    assert numbers[-1] - numbers[0] == pytest.approx(199 * stride, abs=1)
    assert len(numbers) == 200


def test_a_new_stream_replaces_the_old_one_from_its_overdue_frames_on(client: ScriptedClient) -> None:
    client.send("StreamFrames 3D")
    assert client.numbers_until(20_000) == [1, 2, 3]
    client.elapsed_us = 55_000  # three frames are due, and not sent yet
    client.send("StreamFrames FrequencyDivisor:2 6D")
    frames = client.frames_until(90_000)
    found = [(component.type, component.frame_number) for frame in frames for component in frame]
    assert found == [(TOOLS, number) for number in (4, 6, 8, 10)]


def test_stop_ends_the_stream_for_later_measurements_too(client: ScriptedClient) -> None:
    client.send("StreamFrames")
    client.send("StreamFrames Stop")
    assert client.frames_until(50_000) == []
    assert client.session.measurement_stopped() == []
    client.session.measurement_started()
    assert client.session.due_us is None


def test_a_new_byte_order_applies_from_the_next_frame_on(client: ScriptedClient) -> None:
    client.send("StreamFrames 3D")
    big = client.frames_until(0)
    client.send("SetByteOrder LittleEndian")
    little = client.frames_until(10_000, "little")
    assert [frame[0].items[0][0] for frame in big + little] == [0, 1]


def test_frames_more_than_a_second_late_are_dropped_but_not_their_events(client: ScriptedClient) -> None:
    client.send("StreamFrames 3D Events")
    frames = client.frames_until(10 * SECOND_US)
    assert [frame[0].frame_number for frame in frames] == list(range(902, 1002))
    assert client.session.frames_dropped == 901
    assert [event[0] for event in frames[0][1].items] == list(range(1, 129))


def test_a_frame_that_is_not_taken_stays_due(client: ScriptedClient) -> None:
    client.send("StreamFrames 3D")
    next(client.session.due_frames(50_000))
    assert client.session.due_us == 10_000
    assert client.numbers_until(20_000) == [2, 3]


def test_dropped_frames_are_counted_once_and_never_before_they_are_due(client: ScriptedClient) -> None:
    """The count is in the log and in the statistics of the server."""
    client.send("StreamFrames 3D")
    for elapsed_us, dropped in ((0, 1), (0, 1), (5_000, 1), (10_000, 2), (95_000, 10), (40_000, 10)):
        client.session.drop_due_frames(elapsed_us)
        assert client.session.frames_dropped == dropped
    assert client.numbers_until(100_000) == [11]


# Events -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", ["AllFrames", "Frequency:7", "FrequencyDivisor:33"])
@pytest.mark.parametrize("components", ["All", "3D Events", "Events", "Analog Event"])
def test_each_event_is_sent_once_with_a_frame(client: ScriptedClient, rate: str, components: str) -> None:
    client.send(f"StreamFrames {rate} {components}")
    frames = [frame for t in range(0, 10 * SECOND_US, 500_000) for frame in client.frames_until(t)]
    events = [component for frame in frames for component in frame if component.type == EVENT]
    sent = [event[0] for component in events for event in component.items]
    assert sent == list(range(1, len(sent) + 1))
    assert len(sent) >= 130
    assert all(event[1] <= component.timestamp_us for component in events for event in component.items)
    assert all(component.items for component in events)


def test_events_before_the_request_are_not_sent(client: ScriptedClient) -> None:
    client.elapsed_us = 10 * SECOND_US
    client.send("StreamFrames Events")
    [[events]] = client.frames_until(10 * SECOND_US + 70_000)
    assert [event[0] for event in events.items] == [143]


def test_a_stream_of_events_alone_loses_none_while_the_client_does_not_read(client: ScriptedClient) -> None:
    """Its frames exist only if there are events, and these come with the next frame."""
    client.send("StreamFrames Events")
    client.session.drop_due_frames(100_000)
    assert client.session.frames_dropped == 0
    frames = client.frames_until(140_000)
    assert [[event[0] for event in events.items] for [events] in frames] == [[1], [2]]


def test_polling_gets_each_event_once(client: ScriptedClient) -> None:
    events = []
    for elapsed_us in range(0, SECOND_US, 50_000):
        client.elapsed_us = elapsed_us
        client.send("SendCurrentFrame Events")
        [components] = client.frames_until(elapsed_us)
        events += [event[0] for component in components for event in component.items]
    assert events == list(range(1, 14))


# SendCurrentFrame ---------------------------------------------------------------------------


def test_the_current_frame_is_sent_at_once_or_when_there_is_a_newer_one(client: ScriptedClient) -> None:
    """§5.3.4: no client gets the same frame twice."""
    client.elapsed_us = 123_456
    client.send("SendCurrentFrame 3D")
    [[markers]] = client.frames_until(123_456)
    assert (markers.frame_number, markers.timestamp_us) == (13, 120_000)
    client.send("SendCurrentFrame 3D")
    assert client.frames_until(129_999) == []
    assert client.session.due_us == 130_000
    assert client.numbers_until(130_000) == [14]


def test_all_requests_are_answered_in_order_even_without_their_components(client: ScriptedClient) -> None:
    """A client counts its answers; what is missing is an empty frame."""
    for components in ("3D", "Force", "6D"):
        client.send(f"SendCurrentFrame {components}")
    assert [[each.type for each in frame] for frame in client.frames_until(0)] == [[MARKERS], [], [TOOLS]]
    client.send("StreamFrames 3D")
    client.send("SendCurrentFrame 3D")
    assert client.frames_until(9_999) == []
    assert client.numbers_until(10_000) == [2, 2]


def test_a_frame_of_a_slow_stream_does_not_make_older_frames_current(client: ScriptedClient) -> None:
    """SendCurrentFrame waits for a frame newer than any that the client has (§5.3.4)."""
    client.send("StreamFrames FrequencyDivisor:10 3D")
    client.frames_until(0)
    client.elapsed_us = 95_000
    client.send("SendCurrentFrame Analog")
    assert [frame[0].timestamp_us for frame in client.frames_until(95_000)] == [95_000]
    client.send("SendCurrentFrame 3D")
    assert client.session.due_us == 100_000


def test_the_next_frame_is_due_for_the_stream_or_for_an_earlier_request(client: ScriptedClient) -> None:
    """The server's timer waits for this time, so a later one would delay frames."""
    client.send("StreamFrames Analog")
    client.frames_until(0)
    client.send("SendCurrentFrame 3D")
    assert client.session.due_us == 1_000
    client.send("StreamFrames Frequency:1 Analog")
    client.frames_until(1_000)
    assert client.session.due_us == 10_000


def test_stop_keeps_the_events_of_a_request_that_waits(client: ScriptedClient) -> None:
    """Events since the first request belong to the next frame, whatever becomes of the stream."""
    client.send("SendCurrentFrame 3D Events")
    client.frames_until(0)
    client.send("StreamFrames Frequency:1 3D Events")
    client.frames_until(5_000)
    client.elapsed_us = 75_000
    client.send("SendCurrentFrame 3D Events")
    client.send("StreamFrames Stop")
    [[_, events]] = client.frames_until(80_000)
    assert [event[0] for event in events.items] == [1]


def test_no_more_than_1000_requests_wait(client: ScriptedClient) -> None:
    """They may wait for components that never come, and take memory."""
    for _ in range(1000):
        assert client.send("SendCurrentFrame 3D")[0][0] == COMMAND
    refusal = b"Error-1000 requests for the current frame wait already"
    assert client.send("SendCurrentFrame 3D") == [(ERROR, refusal)]
    assert len(client.frames_until(0)) == 1000


# No measurement -----------------------------------------------------------------------------


@pytest.mark.parametrize("sent", ["StreamFrames", "SendCurrentFrame 3D"])
def test_without_a_measurement_requests_get_no_data(client: ScriptedClient, sent: str) -> None:
    client.elapsed_us = None
    assert client.send(sent) == [(COMMAND, f"OK-{sent}".encode()), (NO_DATA, b"")]


def test_clients_that_wait_for_frames_get_no_data_when_the_measurement_ends(client: ScriptedClient) -> None:
    assert client.session.measurement_stopped() == []
    client.send("StreamFrames")
    client.frames_until(0)
    client.send("SendCurrentFrame")
    assert packets_in(b"".join(client.session.measurement_stopped())) == [(NO_DATA, b"")] * 2
    assert client.frames_until(50_000) == []


def test_a_stream_goes_on_in_the_next_measurement_and_loses_no_events(client: ScriptedClient) -> None:
    """Frame numbers start again, and the first frame in time has the events of those that were late."""
    client.elapsed_us = None
    client.send("StreamFrames 3D Events")
    client.session.measurement_started()
    frames = client.frames_until(70_000)
    assert [frame[0].frame_number for frame in frames] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert frames[-1][1] == WireComponent(EVENT, 8, 70_000, [(1, 70_000, -1, -1, -1)])
    client.frames_until(SECOND_US)
    client.session.measurement_stopped()
    client.session.measurement_started()
    assert client.numbers_until(20_000) == [1, 2, 3]
    frames = client.frames_until(3 * SECOND_US)
    assert frames[0][0].frame_number == 202
    assert frames[0][1].items[0][:2] == (1, 70_000)
