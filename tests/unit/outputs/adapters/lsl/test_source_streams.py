"""The LSL streams of one source and their publisher: when they open and close, and what is pushed."""

import itertools
import json
import logging
from typing import Any

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.lsl.output import MAX_WAITING, LslFramePublisher
from gateway.outputs.adapters.lsl.process import Kind, LslReport, Message, decode_samples
from gateway.outputs.adapters.lsl.settings import LslSettings
from gateway.outputs.adapters.lsl.source_streams import MAX_BUFFER_BYTES, CapturedFrame, SourceStreams
from gateway.outputs.adapters.lsl.streams import lsl_stream
from gateway.outputs.adapters.lsl.supervisor import LslProcesses
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    encode_component,
)
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    Tool,
)
from gateway.runtime.losses import Losses
from tests.support.errors import raises
from tests.support.statuses import amounts

ALL = frozenset(WIRE_ORDER)
MARKERS, TOOLS, ANALOG, _, EVENT = WIRE_ORDER
NAN = float("nan")
CAPTURED_US = 5_000_000_000
SUSPENDED_US = 1_000_000
CAPTURED_S = 4999.0
STAMP = Stamp(0, 0, 1, 1)
OPEN, CLOSE = Kind.OPEN, Kind.CLOSE


class Streams:
    """The streams of a source, the messages to the process, and a clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: list[Message] = []
        self.now_s = 1000.0
        self.has_process = True
        monkeypatch.setattr("gateway.outputs.adapters.lsl.source_streams.time.monotonic", lambda: self.now_s)
        self.streams = SourceStreams("lab", "lab-pc", 30, itertools.count(1), self._send)
        self.streams.losses = Losses(logging.getLogger(__name__), "lab to lsl", lambda: self.now_s)

    def _send(self, message: Message) -> bool:
        self.sent.append(message)
        return self.has_process

    def set_parameters(self, parsed: Parameters, frame: CoordinateFrame | None = None) -> None:
        frame = frame or CoordinateFrame("lab")
        self.streams.set_parameters(ServerParameters(b"", 1, 1, parsed=parsed, frame=frame))

    def push(self, *components: bytes, order: ByteOrder = "big", count: int = 1) -> list[Message]:
        """Push equal frames as if everything was wanted; return the messages that this causes."""
        before = len(self.sent)
        frame = frame_of(*components, order=order)
        captured = [CapturedFrame(frame, STAMP, ALL, CAPTURED_US + 10_000 * at) for at in range(count)]
        self.streams.push(captured, frozenset(self.streams.numbers.values()), SUSPENDED_US)
        # The streams that have just opened are wanted by nobody, so push again.
        if any(message.kind is OPEN for message in self.sent[before:]):
            self.streams.push(captured, frozenset(self.streams.numbers.values()), SUSPENDED_US)
        return self.sent[before:]

    @property
    def opened(self) -> list[dict[str, Any]]:
        contents = [json.loads(message.content) for message in self.sent if message.kind is OPEN]
        return [facts | {"tree": tree} for facts, tree in contents]

    @property
    def kinds(self) -> list[tuple[Kind, int]]:
        return [(message.kind, message.stream) for message in self.sent]

    @property
    def lost(self) -> dict[str, tuple[int, int]]:
        return amounts(self.streams.losses.report())


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Streams:
    return Streams(monkeypatch)


def frame_of(*components: bytes, order: ByteOrder = "big") -> RawFrame:
    return split_frame(encode_frame(components, order), order)


def analog(*values: float, timestamp_us: int = 0, order: ByteOrder = "big") -> bytes:
    return encode_component(ANALOG, 1, timestamp_us, np.array(values, ITEM_DTYPES[ANALOG]), order)


def markers(count: int) -> bytes:
    return encode_component(MARKERS, 1, 0, np.zeros(count, ITEM_DTYPES[MARKERS]))


def events(*numbers: int, timestamp_us: int = 0, own_us: int = 0) -> bytes:
    items = np.array([(number, own_us, 3, -1, -1) for number in numbers], LONG_EVENT)
    return encode_component(EVENT, 1, timestamp_us, items)


def with_tools(*labels: str) -> Parameters:
    return Parameters(
        tools=Parameters6D(100.0, tuple(Tool(str(at), label) for at, label in enumerate(labels)))
    )


ONE_MARKER = Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "C7"),)))
BUTTON = ParametersEvents((EventDefinition("7", "Button"),))


def values_of(message: Message) -> list[Any]:
    assert message.kind is Kind.SAMPLES
    found: list[Any] = decode_samples(message.content)[1].tolist()
    return found


def times_of(message: Message) -> list[float]:
    times: list[float] = decode_samples(message.content)[0].tolist()
    return times


# Opening and closing -----------------------------------------------------------------------------


def test_streams_open_with_the_parameters_or_with_their_first_frame(lab: Streams) -> None:
    """A stream on demand has no frames until somebody receives it."""
    lab.set_parameters(Parameters())
    assert lab.opened == []
    lab.set_parameters(Parameters(markers=ONE_MARKER.markers, tools=Parameters6D(100.0, ()), events=BUTTON))
    found = [(opened["name"], opened["num_channels"]) for opened in lab.opened]
    assert found == [("lab_3d", 4), ("lab_event", 1)]
    assert lab.streams.numbers == {MARKERS: 1, EVENT: 2}
    [_, samples] = lab.push(analog(1, 2))
    assert lab.opened[2]["name"] == "lab_analog"
    assert values_of(samples) == [[1, 2]]


@pytest.mark.parametrize(
    ("later", "frame_id", "kinds"),
    [
        pytest.param(with_tools("Probe"), "lab", [], id="the same, as with every connection"),
        pytest.param(Parameters(), "lab", [], id="none"),
        pytest.param(with_tools("Wand"), "lab", [(CLOSE, 1), (OPEN, 2)], id="other labels"),
        pytest.param(
            with_tools("Probe"), "world", [(CLOSE, 1), (OPEN, 2)], id="another frame of coordinates"
        ),
        pytest.param(ONE_MARKER, "lab", [(OPEN, 2), (CLOSE, 1)], id="another component"),
    ],
)
def test_streams_stay_open_while_their_channels_are_the_same(
    lab: Streams, later: Parameters, frame_id: str, kinds: list[tuple[Kind, int]]
) -> None:
    lab.set_parameters(with_tools("Probe"))
    for _ in range(2):
        lab.now_s += 10
        lab.set_parameters(later, CoordinateFrame(frame_id))
    assert lab.kinds == [(OPEN, 1), *kinds]
    assert len({opened["source_id"] for opened in lab.opened}) == len(lab.opened)
    assert list(lab.streams.numbers.values()) == [len(lab.opened)]


def test_items_that_come_and_go_are_nan_and_more_items_open_another_stream(lab: Streams) -> None:
    lab.set_parameters(Parameters(analog=ParametersAnalog(tuple(AnalogChannel(str(at)) for at in range(3)))))
    assert values_of(lab.push(analog(4))[0]) == [pytest.approx([4, NAN, NAN], nan_ok=True)]
    assert values_of(lab.push(analog(5, 6, 7))[0]) == [[5, 6, 7]]
    lab.now_s += 10
    [close, opened, samples] = lab.push(analog(1, 2, 3, 4))
    assert (close.kind, opened.kind, values_of(samples)) == (CLOSE, OPEN, [[1, 2, 3, 4]])


def test_streams_do_not_pile_up_however_often_labels_change(lab: Streams) -> None:
    for number in range(1000):
        lab.set_parameters(with_tools(f"Tool {number}"))
        lab.now_s += 0.01
        lab.streams.open_waiting()
    assert sum({OPEN: 1, CLOSE: -1}.get(message.kind, 0) for message in lab.sent) <= 1
    assert len(lab.opened) <= 11
    lab.now_s += 10
    lab.streams.open_waiting()
    assert lab.opened[-1]["tree"][0][1][0][1][0] == ["label", "Tool 999_X"]
    assert (lab.streams.waiting, lab.lost) == ({}, {})


def test_a_stream_that_waits_is_described_only_once(lab: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    described: list[int] = []

    def counting(*arguments: Any) -> Any:
        described.append(arguments[2])
        return lsl_stream(*arguments)

    monkeypatch.setattr("gateway.outputs.adapters.lsl.source_streams.lsl_stream", counting)
    lab.push(analog(1, 2))
    for _ in range(100):
        lab.push(analog(1, 2, 3))
    assert described == [2, 3]
    lab.now_s += 10
    lab.streams.open_waiting()
    assert [opened["num_channels"] for opened in lab.opened] == [2, 3]
    assert described == [2, 3, 3]


def test_another_process_gets_the_same_streams_and_closing_closes_them(lab: Streams) -> None:
    lab.push(analog(1), markers(2))
    first = [message for message in lab.sent if message.kind is OPEN]
    before = len(lab.sent)
    lab.streams.reopen()
    assert lab.sent[before:] == first
    lab.streams.close()
    assert {message.stream for message in lab.sent if message.kind is CLOSE} == {1, 2}
    assert lab.streams.numbers == {}


def test_the_memory_for_slow_receivers_is_bounded(lab: Streams) -> None:
    lab.push(analog(1))
    lab.push(markers(5000))
    [small, large] = lab.opened
    assert small["buffer_s"] == 30
    assert large["buffer_s"] * 100 * 4 * large["num_channels"] <= MAX_BUFFER_BYTES


# What is pushed ----------------------------------------------------------------------------------


def test_equal_frames_are_pushed_together_with_their_capture_times(lab: Streams) -> None:
    lab.push(analog(1, 2))
    [samples] = lab.push(analog(1, 2, order="little"), count=3, order="little")
    assert times_of(samples) == [CAPTURED_S, CAPTURED_S + 0.01, CAPTURED_S + 0.02]
    assert values_of(samples) == [[1, 2]] * 3


def test_many_frames_of_few_items_are_not_pushed_at_once_in_a_stream_of_many_channels(lab: Streams) -> None:
    """A server could so make the gateway fill its memory with NaN."""
    lab.push(markers(10_000))
    times = [times_of(message) for message in lab.push(markers(1), count=60)]
    assert [len(each) for each in times] == [25, 25, 10]
    assert len({time_s for each in times for time_s in each}) == 60


def test_only_wanted_streams_and_components_are_pushed(lab: Streams) -> None:
    lab.push(analog(1), markers(1))
    frame = frame_of(analog(1), markers(1))
    before = len(lab.sent)
    lab.streams.push([CapturedFrame(frame, STAMP, ALL, 0)], frozenset({2}), 0)
    lab.streams.push([CapturedFrame(frame, STAMP, frozenset({ANALOG}), 0)], frozenset({1, 2}), 0)
    assert [message.stream for message in lab.sent[before:]] == [2, 1]


def test_a_component_that_comes_twice_is_two_samples_at_their_own_times(lab: Streams) -> None:
    """Unless the second time is of another clock."""
    lab.push(analog(1))
    for timestamp_us, time_s in ((2_500, CAPTURED_S + 0.0025), (5_000_000_000, CAPTURED_S)):
        first, second = lab.push(analog(1), analog(2, timestamp_us=timestamp_us))
        assert (values_of(first), times_of(first)) == ([[1]], [CAPTURED_S])
        assert (values_of(second), times_of(second)) == ([[2]], [time_s])


@pytest.mark.parametrize(
    ("apart_us", "used_us"),
    [
        (0, 0),
        (1_000_000, 1_000_000),
        (-1_000_000, -1_000_000),
        (1_000_001, 0),
        (-1_000_001, 0),
        (10**15, 0),
    ],
)
def test_an_event_with_a_time_of_another_clock_is_at_its_frame(
    lab: Streams, apart_us: int, used_us: int
) -> None:
    """Some servers count events from the start of a trial, or since 1970."""
    lab.set_parameters(Parameters(events=BUTTON))
    frame_us = 5_000_000
    message = lab.push(events(7, timestamp_us=frame_us, own_us=frame_us + apart_us))[-1]
    [time_s], _ = json.loads(message.content)
    assert time_s == pytest.approx(CAPTURED_S + used_us / 1e6, abs=1e-6)


def test_events_are_texts_at_their_own_time_or_at_that_of_their_frame(lab: Streams) -> None:
    lab.set_parameters(Parameters(events=BUTTON))
    [message] = lab.push(events(7, 8, timestamp_us=100_000, own_us=97_000))
    assert message.kind is Kind.TEXTS
    times, texts = json.loads(message.content)
    assert texts == ["Button: param1: 3", "event 8: param1: 3"]
    assert times == pytest.approx([CAPTURED_S - 0.003] * 2)
    [short] = lab.push(encode_component(EVENT, 1, 0, np.array([(9, -1, -1, -1)], SHORT_EVENT)))
    assert json.loads(short.content) == [[CAPTURED_S], ["event 9"]]


def test_components_without_items_are_no_samples(lab: Streams) -> None:
    lab.push(analog(1), events(7))
    assert lab.push(events()) == []
    [empty] = lab.push(analog())
    assert values_of(empty) == [pytest.approx([NAN], nan_ok=True)]


def test_what_cannot_be_pushed_is_counted(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"), CoordinateFrame("lab", None))
    assert lab.sent == []
    lab.push(markers(1), analog(1), count=5)
    assert [opened["name"] for opened in lab.opened] == ["lab_analog"]
    assert lab.lost == {"unknown unit": (10, 10)}
    lab.set_parameters(Parameters())
    lab.push(markers(20_000))
    assert len(lab.opened) == 1
    lab.has_process = False
    lab.push(analog(1), count=3)
    assert lab.lost == {"unknown unit": (10, 10), "too many channels": (1, 1), "not open": (3, 3)}


# The publisher -----------------------------------------------------------------------------------


class Publisher(Streams):
    """A publisher, and a process for LSL of which the test says who receives."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch)
        self.changes = 0
        self.processes = LslProcesses(LslSettings(enabled=True), self._changed)
        self.publisher = LslFramePublisher(self.streams, self.processes, lambda: None, lambda _: None)
        self.publisher.on_change = self._changed
        self.processes._socket = object()  # type: ignore[assignment]  # as if a process ran
        self.receive()

    def _changed(self) -> None:
        self.changes += 1

    def receive(self, *components: ComponentType) -> None:
        """Have a receiver of the streams of these components, and of no others."""
        wanted = tuple(self.streams.numbers[each] for each in components)
        self.processes._take(LslReport(ready="118", wanted=wanted))

    def prepare(self, *components: bytes) -> bool:
        is_wanted = self.publisher.prepare(frame_of(*components).layout, ALL)
        self.publisher.send_waiting(0)
        return is_wanted

    def publish(self, *components: bytes) -> None:
        self.publisher.publish(frame_of(*components), STAMP, ALL)


@pytest.fixture
def publisher(monkeypatch: pytest.MonkeyPatch) -> Publisher:
    return Publisher(monkeypatch)


def test_a_frame_is_wanted_if_somebody_receives_one_of_its_streams(publisher: Publisher) -> None:
    both = (markers(3), analog(1, 2))
    assert not publisher.prepare(*both)
    assert publisher.kinds == [(OPEN, 1), (OPEN, 2)]
    publisher.receive(MARKERS)
    assert publisher.changes == 1
    assert publisher.prepare(*both)
    assert not publisher.publisher.prepare(frame_of(*both).layout, ALL - {MARKERS})
    assert not publisher.prepare(analog(1, 2))


def test_streams_open_for_the_most_items_without_any_receiver(publisher: Publisher) -> None:
    """Other parameters make the publisher learn the layouts again."""
    for values in ((1, 2), (1, 2, 3), (1, 2), (1, 2, 3), (1,)):
        publisher.prepare(analog(*values))
        publisher.now_s += 10
    publisher.prepare(analog(1), analog(1, 2, 3, 4))
    assert publisher.kinds == [(OPEN, 1), (CLOSE, 1), (OPEN, 2), (CLOSE, 2), (OPEN, 3)]
    assert publisher.streams._streams[ANALOG].num_items == 4
    publisher.now_s += 10
    publisher.publisher.set_parameters(ServerParameters(b"", 1, 2, frame=CoordinateFrame("lab")))
    assert publisher.changes == 1
    publisher.prepare(analog(1, 2))
    assert publisher.streams._streams[ANALOG].version == 1


def test_frames_of_received_streams_are_refused_until_the_next_process_is_ready(publisher: Publisher) -> None:
    publisher.prepare(markers(3))
    publisher.receive(MARKERS)
    publisher.publish(markers(3))
    publisher.processes._report = LslReport()
    assert publisher.prepare(markers(3))
    with pytest.raises(OutputError, match="LSL: ") as refused:
        publisher.publish(markers(3))
    assert refused.value.cause == "not open"
    assert publisher.lost == {"not open": (1, 1)}
    publisher.receive()
    assert not publisher.prepare(markers(3))


def test_what_waits_for_the_thread_is_bounded_and_streams_open_nevertheless(publisher: Publisher) -> None:
    for _ in range(MAX_WAITING):
        publisher.publish(markers(3))
    with pytest.raises(OutputError, match="too busy") as refused:
        publisher.publish(markers(3))
    assert refused.value.cause == "queue full"
    publisher.prepare(analog(1, 2))
    assert ANALOG in publisher.streams.numbers


def test_a_closed_publisher_takes_nothing(publisher: Publisher) -> None:
    publisher.publisher.close()
    assert not publisher.prepare(markers(3))
    assert publisher.sent == []
    with raises(OutputError, cause="closed"):
        publisher.publish(markers(3))
