"""Frames of a live source for its clients: passed on, cut, converted, joined by time stamp, and events."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from gateway.outputs.adapters.rtc3d.live_frames import KEPT_EVENTS
from gateway.outputs.adapters.rtc3d.live_server import LiveScene
from gateway.rtc3d.components import WIRE_ORDER, ByteOrder, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.packets import Packet
from gateway.rtc3d.parameters import General
from gateway.session.server.client_session import ClientSession
from gateway.session.server.scene import FrameSource
from tests.unit.outputs.adapters.rtc3d.scripted_server import (
    FAST,
    SLOW,
    TOOL_OUT_OF_VIEW,
    analog,
    body,
    component,
    event,
    event_of,
    frame_of_markers,
    markers,
)
from tests.unit.session.server.wire import COMMAND, EVENT, WireComponent, components_in

ALL = frozenset(WIRE_ORDER)
UNKNOWN = bytes.fromhex("0000000c 00000063 01020304")
WHOLE = body(markers(7, 10_000), TOOL_OUT_OF_VIEW, event(7, 10_000, 3), UNKNOWN) + b"\n"
ONE_TOOL = body(TOOL_OUT_OF_VIEW)
AT_7 = (markers(7, 10_000), analog(70, 10_001))
BOTH = "StreamFrames 3D Analog"
each_order = pytest.mark.parametrize("fast_first", [False, True])


class LiveSource:
    """A live source with clients; time passes only by ``wait``."""

    def __init__(self, *, played: int = 0, fast_first: bool = False) -> None:
        self.scene = LiveScene("lab")
        self.scene._arrivals.began_us = -1_000_000_000  # frames do not wait until rates are known
        self.now_us = 0
        self._clients: list[LiveClient] = []
        self.scene.start()
        self.play(1, played, fast_first=fast_first)

    def client(self, *commands: str) -> "LiveClient":
        self._clients.append(LiveClient(self))
        for command in commands:
            self._clients[-1].send(command)
        return self._clients[-1]

    def play(self, first: int, last: int, *, fast_first: bool = False) -> None:
        """Let frames of 100 Hz markers and 1000 Hz analog arrive on two streams."""
        for number in range(first, last + 1):
            timestamp_us = 10_000 * number
            slow = (body(markers(number, timestamp_us), event(number, timestamp_us, number)), SLOW)
            fast = (body(analog(10 * number, timestamp_us)), FAST)
            for each in (fast, slow) if fast_first else (slow, fast):
                self.arrive(*each)
            for step in range(1, 10):
                self.wait(1000)
                self.arrive(body(analog(10 * number + step, timestamp_us + 1000 * step)), FAST)
            self.wait(1000)

    def arrive(
        self,
        frame: bytes,
        stream: int = SLOW,
        byte_order: ByteOrder = "big",
        wanted: frozenset[ComponentType] = ALL,
    ) -> None:
        """Let a frame arrive, and send what is due then."""
        self.scene.add(split_frame(frame, byte_order), stream, wanted, self.now_us)
        self.send()

    def wait(self, us: int) -> None:
        """Let time pass; send what is due when the scene says so."""
        until_us = self.now_us + us
        while (due_us := self.scene.advance(self.now_us)) is not None and due_us <= until_us:
            self.now_us = max(due_us, self.now_us)
            self.send()
        self.now_us = until_us
        self.send()

    def send(self) -> None:
        elapsed_us = max(self.now_us, self.scene.newest_us)
        self.scene.advance(elapsed_us)
        for client in self._clients:
            client.bodies += [packet.packet[8:] for packet in client.session.due_frames(elapsed_us)]


class LiveClient:
    """One client; ``bodies`` are the bodies of the frames that it got."""

    def __init__(self, source: LiveSource) -> None:
        self.bodies: list[bytes] = []
        self._source = source
        self.session = ClientSession(self)

    # SessionHost ----------------------------------------------------------------------------

    def frames(self, components: Sequence[ComponentType]) -> FrameSource:
        return self._source.scene.frames(components)

    def parameters_xml(self, sections: Sequence[str]) -> bytes:
        return self._source.scene.parameters_xml(sections, General())

    def frames_requested(self) -> int:
        return max(self._source.now_us, self._source.scene.newest_us)

    def record_for(self, _duration_s: float | None) -> None:
        """Do nothing: these clients do not record."""

    # The client -----------------------------------------------------------------------------

    def send(self, text: str) -> None:
        self.session.answer(Packet(COMMAND, text.encode()))
        self._source.send()

    def take(self, byte_order: ByteOrder = "big") -> list[list[WireComponent]]:
        """Return the frames that have come since the last call."""
        bodies, self.bodies = self.bodies, []
        return [components_in(each, byte_order) for each in bodies]

    def event_ids(self) -> list[list[int]]:
        """Return the ids of the events in each of these frames."""
        return [[int(item[0]) for c in frame if c.type == EVENT for item in c.items] for frame in self.take()]

    def numbers(self) -> list[list[int]]:
        """Return the frame numbers of the components of each of these frames."""
        return [[each.frame_number for each in frame] for frame in self.take()]


@pytest.mark.parametrize(
    ("requested", "arrived", "sent"),
    [
        ("", WHOLE, [WHOLE]),
        ("AllFrames 3D 6D Analog Force Events", WHOLE, [WHOLE]),
        ("6D Analog", body(*AT_7, TOOL_OUT_OF_VIEW, event(7, 10_000, 3)), [body(TOOL_OUT_OF_VIEW, AT_7[1])]),
        ("6D Analog", body(TOOL_OUT_OF_VIEW, UNKNOWN), [ONE_TOOL]),
        ("3D", body(*AT_7, markers(8, 10_100)), [body(AT_7[0], markers(8, 10_100))]),
        ("", body(), []),
    ],
)
def test_components_are_passed_on_or_cut_out(requested: str, arrived: bytes, sent: list[bytes]) -> None:
    source = LiveSource()
    client = source.client(f"StreamFrames {requested}")
    source.arrive(arrived)
    assert client.bodies == sent


def test_components_that_the_gateway_skips_are_left_out() -> None:
    source = LiveSource()
    client = source.client("StreamFrames")
    source.arrive(body(markers(7, 10_000), event(7, 10_000, 3)), wanted=frozenset({ComponentType.EVENT}))
    assert client.bodies == [body(event(7, 10_000, 3))]


def test_a_client_gets_its_byte_order_whatever_the_server_sends() -> None:
    source = LiveSource()
    big, little = source.client("StreamFrames"), source.client("SetByteOrder LittleEndian", "StreamFrames")
    as_big = body(markers(7, 10_000), analog(70, 10_000))
    as_little = body(markers(7, 10_000, "little"), analog(70, 10_000, "little"), byte_order="little")
    source.arrive(as_big)
    source.arrive(as_little, byte_order="little")
    assert (big.bodies, little.bodies) == ([as_big] * 2, [as_little] * 2)
    source.arrive(ONE_TOOL)
    assert little.bodies[-1].endswith(b"\xff" * 32)  # out of view in both byte orders


def test_frames_without_the_components_of_a_client_are_none_for_it() -> None:
    source = LiveSource()
    client = source.client("StreamFrames FrequencyDivisor:2 3D")
    for number in range(1, 7):
        source.arrive(frame_of_markers(number))
        source.arrive(body(analog(number, 10_000 * number + 5000)))
    assert client.numbers() == [[1], [3], [5]]


def test_a_frequency_is_that_of_the_time_stamps() -> None:
    source = LiveSource()
    client = source.client("StreamFrames Frequency:60 3D")  # before the rate is known
    for number in range(1, 401):
        source.arrive(body(markers(number, 5_000 * number)))
    numbers = [frame[0] for frame in client.numbers()][20:]
    gaps = [later - earlier for earlier, later in pairwise(numbers)]
    assert set(gaps) == {3, 4}
    assert sum(gaps) / len(gaps) == pytest.approx(200 / 60, rel=0.02)


def test_the_current_frame_is_the_newest_and_each_is_sent_once() -> None:
    """What was before a pause is not current."""
    source = LiveSource()
    source.client("StreamFrames")
    for number in (1, 2):
        source.arrive(frame_of_markers(number))
    client = source.client("SendCurrentFrame 3D")
    assert client.numbers() == [[2]]
    client.send("SendCurrentFrame 3D")
    assert client.numbers() == []
    source.arrive(frame_of_markers(3))
    source.arrive(frame_of_markers(4))
    assert client.numbers() == [[3]]
    held = source.scene.frames([ComponentType.MARKERS])  # the next client shares it
    source.scene.forget_frames()
    other = source.client("SendCurrentFrame 3D")
    assert held is source.scene.frames([ComponentType.MARKERS])
    assert other.numbers() == []
    source.arrive(frame_of_markers(9))
    assert other.numbers() == [[9]]


def test_little_is_kept_of_large_frames() -> None:
    source = LiveSource()
    client = source.client("StreamFrames 3D")
    large = body(component(1, 1, 10_000, [(0, 0, 0, 0)] * 100_000))
    for _ in range(40):
        source.arrive(large)
        client.bodies.clear()
    assert sum(arrival.num_bytes for arrival in source.scene._arrivals.frames.since(0)) < 10_000_000


# Joined frames ------------------------------------------------------------------------------


def joined(first: int, last: int) -> list[list[int]]:
    """Return the frame numbers of markers and analog in complete frames of what is played."""
    return [[number, 10 * number] for number in range(first, last + 1)]


@each_order
def test_components_of_two_streams_are_joined_by_time_stamp(fast_first: bool) -> None:
    source = LiveSource(played=3, fast_first=fast_first)
    client, whole = source.client(BOTH), source.client("StreamFrames")
    source.play(4, 20, fast_first=fast_first)
    assert client.numbers() == joined(4, 20)
    assert whole.bodies[0] == frame_of_markers(4, analog(40, 40_000), event(4, 40_000, 4))


def test_a_client_of_one_stream_gets_every_frame_of_it() -> None:
    source = LiveSource()
    client = source.client("StreamFrames Analog")
    source.play(1, 5)
    assert client.numbers() == [[number] for number in range(10, 60)]


def test_while_the_slower_stream_has_no_frames_the_faster_one_sets_the_rate() -> None:
    source = LiveSource(played=5)
    client = source.client(BOTH)
    source.wait(1_100_000)
    source.arrive(body(analog(2000, 2_000_000)), FAST)
    assert client.numbers() == [[2000]]
    source.play(300, 304)
    assert client.numbers()[-4:] == joined(301, 304)


@each_order
def test_a_new_measurement_is_joined_from_its_first_frames(fast_first: bool) -> None:
    source = LiveSource()
    client = source.client(BOTH)
    source.play(1000, 1010)
    client.take()
    source.play(1, 5, fast_first=fast_first)
    assert client.numbers()[1:] == joined(2, 5)


# Events ----------------------------------------------------------------------------------------


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
