"""What one client gets from the RT server: replies, parameters, and frames in time."""

import math
import struct
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.rtc3d.parameters_xml import parse_parameters
from tests.unit.session.server.scripted_client import ScriptedClient
from tests.unit.session.server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    MARKERS,
    NO_DATA,
    TOOLS,
    XML,
    WireComponent,
    packets_in,
)

SECOND_US = 1_000_000

# Events with id 1 (field note 16): frame number -1, time stamp 0.
START_BIG, START_LITTLE = (
    struct.pack(sign + "IIIiqIiqiii", 1, 48, 5, -1, 0, 1, 1, 0, -1, -1, -1) for sign in (">", "<")
)
STOP_BIG, STOP_LITTLE = (start[:28] + bytes(4) + start[32:] for start in (START_BIG, START_LITTLE))


@pytest.fixture
def client() -> ScriptedClient:
    return ScriptedClient()


def test_a_command_is_acknowledged_as_it_was_sent(client: ScriptedClient) -> None:
    """NDI's clients compare the text, without what may follow a command."""
    for sent in (
        *(b"Version 1.0", b"version 1.0\n", b"SetByteOrder LittleEndian\0", b"StreamFrames Stop"),
        *(b"StreamFrames", b"StreamFrames All", b"StreamFrames Frequency:30 3D Analog"),
        b"SendCurrentFrame 3D 6D Analog Force Events ",
    ):
        assert client.send(sent) == [(COMMAND, b"OK-" + sent.rstrip(b" \n\0"))]
    assert client.send("BYE\0") == [(COMMAND, b"bye")]  # as NDI's client expects it
    assert client.session.said_bye


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (b"Version 2.0", b"Version 2.0 is not supported; this server speaks version 1.0"),
        *(
            (b"", b"Empty command"),
            (b"\xff\xfe", b"Unknown command"),
            (b"Bye now", b"Bye takes no parameter"),
        ),
        (b"StreamFrames FrequencyDivisor:0", b"Unknown rate 'f"),
        (b"Recording Started", b"Recording takes Start or Stop"),
    ],
)
def test_a_bad_command_gets_an_error_with_why(client: ScriptedClient, sent: bytes, message: bytes) -> None:
    """The text is ASCII, and nothing has changed: a stream goes on with its rate."""
    client.send("StreamFrames 3D")
    [(packet_type, text)] = client.send(sent)
    assert packet_type == ERROR
    assert text.isascii()
    assert text.startswith(b"Error-" + message)
    assert (client.session.said_bye, client.session.is_recording) == (False, False)
    assert client.numbers_until(20_000) == [1, 2, 3]


def test_packets_that_only_servers_send_get_an_error(client: ScriptedClient) -> None:
    """A client's author learns which type commands have."""
    for packet_type in (0, 2, 4, 5, 6, 0xFFFFFFFF):
        text = b"Error-Packets of type %d are not accepted; commands have type 1 (string)" % packet_type
        assert client.send(b"", packet_type) == [(ERROR, text)]


RECORDING = b"Recording Start,file=C:\\My takes\\A b.c3d"


@pytest.mark.parametrize("extra", [b"", b"\n", b"\0", b"\r\n\0"])
@pytest.mark.parametrize(
    ("start", "stop", "packet_type"),
    [
        *((START_BIG, STOP_BIG, DATA), (START_LITTLE, STOP_LITTLE, DATA)),
        *((RECORDING, b"Recording Stop", COMMAND), (b"recording start", b"recording stop", COMMAND)),
    ],
)
def test_a_recording_is_started_and_stopped(
    client: ScriptedClient, start: bytes, stop: bytes, packet_type: int, extra: bytes
) -> None:
    """Field notes 16 to 18: by WaveFront's data frame, which gets no reply, or by commands."""
    for sent, is_recording in ((start, True), (stop, False)):
        replies = [(COMMAND, b"OK-" + sent)] if packet_type == COMMAND else []
        assert client.send(sent + extra, packet_type) == replies
        assert client.session.is_recording is is_recording


@pytest.mark.parametrize(
    ("options", "duration_s"),
    [
        ("", None),
        (",file=take1,duration=5,durationunits=seconds", 5),
        (",DurationUnits=Minutes,Duration = 1.5 ,file=take1.tsv", 90),
    ],
)
def test_a_duration_ends_a_recording(client: ScriptedClient, options: str, duration_s: float | None) -> None:
    """Field note 26, in any order and any case."""
    client.send(f"Recording Start{options}")
    assert client.recording_durations_s == [duration_s]
    client.session.end_recording()
    assert (client.session.is_recording, client.recording_durations_s[1:]) == (False, [None])


@pytest.mark.parametrize("options", [",duration=soon", ",duration=-1", ",duration=5,durationunits=frames"])
def test_a_duration_that_is_not_understood_is_an_error(client: ScriptedClient, options: str) -> None:
    [(packet_type, text)] = client.send(f"Recording Start{options}")
    assert (packet_type, b"one of seconds, minutes, hours" in text) == (ERROR, True)
    assert not client.session.is_recording


@pytest.mark.parametrize(
    "body",
    [
        b"",
        START_BIG[:-1],
        START_BIG[:12] + bytes(4) + START_BIG[16:],  # frame number 0
        START_BIG[:31] + b"\x02" + START_BIG[32:],  # event 2
        b"\0\0\0\2" + 2 * START_BIG[4:],  # two components
        bytes(4),  # no component
    ],
)
def test_other_data_frames_from_a_client_get_an_error(client: ScriptedClient, body: bytes) -> None:
    """Nothing but exactly this frame starts a recording."""
    [(packet_type, text)] = client.send(body, DATA)
    assert packet_type == ERROR
    assert b"data frame" in text
    assert not client.session.is_recording


def test_the_reply_to_send_parameters_is_xml_with_the_requested_sections(client: ScriptedClient) -> None:
    """§5.3.3: all sections by default."""
    [(packet_type, xml)] = client.send("SendParameters 3d General")
    parameters = parse_parameters(xml).parameters
    assert packet_type == XML
    assert parameters.general is not None
    assert parameters.general.name == "server under test"
    assert parameters.markers == client.scene.parameters.markers
    assert parameters.events is None
    for sent in ("SendParameters", "SendParameters All\0"):
        parameters = parse_parameters(client.send(sent)[0][1]).parameters
        assert None not in (parameters.general, parameters.markers, parameters.events)


# Streams ------------------------------------------------------------------------------------


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
def test_rates_of_streams(client: ScriptedClient, requested: str, until_us: int, numbers: list[int]) -> None:
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


@given(
    st.lists(st.tuples(st.integers(0, 40), st.sampled_from(["StreamFrames 3D Events", "StreamFrames Stop"])))
)
def test_each_event_while_a_client_streams_is_sent_once_and_no_other(steps: list[tuple[int, str]]) -> None:
    """Against a plain model: an event each 70 ms, and frames each 10 ms from a request until it ends."""
    client = ScriptedClient()
    sent: list[float] = []
    expected: list[int] = []
    elapsed_us = 5_000  # never the time of a frame
    from_us: int | None = None
    for wait, command in [*steps, (10, "StreamFrames Stop")]:
        until_us = elapsed_us + 10_000 * wait
        for frame in client.frames_until(until_us):
            sent += [event[0] for component in frame if component.type == EVENT for event in component.items]
        if from_us is not None:
            expected += [
                n for n in range(1, 10_000) if from_us < 70_000 * n <= until_us and n not in expected
            ]
        elapsed_us = until_us
        client.send(command)
        from_us = elapsed_us if command != "StreamFrames Stop" else None
    assert sent == expected


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
