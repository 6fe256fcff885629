"""The LSL streams of one source: when they open and close, and what is pushed."""

import itertools
import json
import logging
from typing import Any

import numpy as np
import pytest

from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lsl.source_streams import MAX_BUFFER_BYTES, CapturedFrame, SourceStreams
from gateway.outputs.lsl.streams import DescribedSource, LslStream, lsl_stream
from gateway.outputs.lsl.wire import Kind, Message, decode_samples
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    encode_component,
)
from gateway.rtc3d.frames import encode_frame, split_frame
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
from tests.losses import amounts

ALL = frozenset(WIRE_ORDER)
FRAME = CoordinateFrame("lab")
CAPTURED_US = 5_000_000_000
SUSPENDED_US = 1_000_000
CAPTURED_S = 4999.0


class Streams:
    """The streams of a source, the messages to the process, and a clock that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, buffer_s: int = 30) -> None:
        self.sent: list[Message] = []
        self.now_s = 1000.0
        self.has_process = True
        monkeypatch.setattr("gateway.outputs.lsl.source_streams.time.monotonic", lambda: self.now_s)
        self.streams = SourceStreams("lab", "lab-pc", buffer_s, itertools.count(1), self._send)
        self.streams.losses = Losses(logging.getLogger(__name__), "lab to lsl", lambda: self.now_s)

    def _send(self, message: Message) -> bool:
        self.sent.append(message)
        return self.has_process

    def set_parameters(self, parsed: Parameters, frame: CoordinateFrame = FRAME) -> None:
        self.streams.set_parameters(ServerParameters(b"", 1, 1, parsed=parsed, frame=frame))

    def push(self, *components: bytes, order: ByteOrder = "big", count: int = 1) -> list[Message]:
        """Push equal frames as if everything was wanted; return the messages that this causes."""
        before = len(self.sent)
        frame = split_frame(encode_frame(components, order), order)
        captured = [
            CapturedFrame(frame, Stamp(0, 0, 1, 1), ALL, CAPTURED_US + 10_000 * at) for at in range(count)
        ]
        self.streams.push(captured, frozenset(self.streams.numbers.values()), SUSPENDED_US)
        # The streams that have just opened are wanted by nobody, so push again.
        if any(message.kind is Kind.OPEN for message in self.sent[before:]):
            self.streams.push(captured, frozenset(self.streams.numbers.values()), SUSPENDED_US)
        return self.sent[before:]

    @property
    def opened(self) -> list[dict[str, Any]]:
        contents = [json.loads(message.content) for message in self.sent if message.kind is Kind.OPEN]
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


def analog(*values: float, timestamp_us: int = 0, order: ByteOrder = "big") -> bytes:
    items = np.array(values, ITEM_DTYPES[ComponentType.ANALOG])
    return encode_component(ComponentType.ANALOG, 1, timestamp_us, items, order)


def markers(count: int) -> bytes:
    return encode_component(ComponentType.MARKERS, 1, 0, np.zeros(count, ITEM_DTYPES[ComponentType.MARKERS]))


def events(*numbers: int, timestamp_us: int = 0, own_us: int = 0) -> bytes:
    items = np.array([(number, own_us, 3, -1, -1) for number in numbers], LONG_EVENT)
    return encode_component(ComponentType.EVENT, 1, timestamp_us, items)


def with_tools(*labels: str) -> Parameters:
    tools = tuple(Tool(str(at), label) for at, label in enumerate(labels))
    return Parameters(tools=Parameters6D(100.0, tools))


def values_of(message: Message) -> list[Any]:
    assert message.kind is Kind.SAMPLES
    found: list[Any] = decode_samples(message.content)[1].tolist()
    return found


def times_of(message: Message) -> list[float]:
    times: list[float] = decode_samples(message.content)[0].tolist()
    return times


# Opening and closing -----------------------------------------------------------------------------


def test_streams_open_with_the_parameters_before_any_frame(lab: Streams) -> None:
    """A stream on demand has no frames until somebody receives it."""
    lab.set_parameters(
        Parameters(
            markers=Parameters3D(100.0, "mm", (Marker("1", "C7"),)),
            tools=Parameters6D(100.0, ()),
            events=ParametersEvents((EventDefinition("7", "Button"),)),
        )
    )
    assert [(opened["name"], opened["num_channels"]) for opened in lab.opened] == [
        ("lab_3d", 4),
        ("lab_event", 1),
    ]
    assert lab.streams.numbers == {ComponentType.MARKERS: 1, ComponentType.EVENT: 2}


def test_without_parameters_a_stream_opens_with_its_first_frame(lab: Streams) -> None:
    lab.set_parameters(Parameters())
    assert lab.opened == []
    [_, samples] = lab.push(analog(1, 2))
    assert [opened["name"] for opened in lab.opened] == ["lab_analog"]
    assert values_of(samples) == [[1, 2]]


def test_the_same_parameters_again_change_nothing(lab: Streams) -> None:
    """Every connection gives them again."""
    for _ in range(3):
        lab.set_parameters(with_tools("Probe", "Wand"))
    assert lab.kinds == [(Kind.OPEN, 1)]


def test_other_labels_close_the_stream_and_open_another(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"))
    lab.now_s += 10
    lab.set_parameters(with_tools("Wand"))
    assert lab.kinds == [(Kind.OPEN, 1), (Kind.CLOSE, 1), (Kind.OPEN, 2)]
    assert lab.opened[0]["source_id"] != lab.opened[1]["source_id"]
    assert lab.streams.numbers == {ComponentType.TOOLS: 2}


def test_another_frame_of_coordinates_is_another_stream(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"))
    lab.now_s += 10
    lab.set_parameters(with_tools("Probe"), CoordinateFrame("world"))
    assert lab.kinds == [(Kind.OPEN, 1), (Kind.CLOSE, 1), (Kind.OPEN, 2)]


def test_items_that_come_and_go_are_nan_in_the_same_stream(lab: Streams) -> None:
    lab.push(analog(1, 2, 3))
    assert values_of(lab.push(analog(4))[0]) == [pytest.approx([4, np.nan, np.nan], nan_ok=True)]
    assert values_of(lab.push(analog(5, 6, 7))[0]) == [[5, 6, 7]]
    assert len(lab.opened) == 1


def test_more_items_than_channels_open_another_stream(lab: Streams) -> None:
    lab.push(analog(1, 2))
    lab.now_s += 10
    [close, opened, samples] = lab.push(analog(1, 2, 3))
    assert (close.kind, opened.kind) == (Kind.CLOSE, Kind.OPEN)
    assert values_of(samples) == [[1, 2, 3]]


def test_a_stream_has_channels_for_all_labels_even_if_frames_have_fewer(lab: Streams) -> None:
    lab.set_parameters(Parameters(analog=ParametersAnalog(tuple(AnalogChannel(str(at)) for at in range(5)))))
    lab.push(analog(1, 2))
    assert [opened["num_channels"] for opened in lab.opened] == [5]


def test_streams_do_not_pile_up_however_often_labels_change(lab: Streams) -> None:
    for number in range(1000):
        lab.set_parameters(with_tools(f"Tool {number}"))
        lab.now_s += 0.01
        lab.streams.open_waiting()
    num_open = sum({Kind.OPEN: 1, Kind.CLOSE: -1}.get(message.kind, 0) for message in lab.sent)
    assert num_open <= 1
    assert len(lab.opened) <= 11
    lab.now_s += 10
    lab.streams.open_waiting()
    assert lab.opened[-1]["tree"][0][1][0][1][0] == ["label", "Tool 999_X"]
    assert lab.streams.waiting == {}
    assert lab.lost == {}


def test_a_stream_that_waits_is_not_described_for_every_frame(
    lab: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    described = []

    def counting(source: DescribedSource, component: ComponentType, num_items: int) -> LslStream:
        described.append(num_items)
        return lsl_stream(source, component, num_items)

    monkeypatch.setattr("gateway.outputs.lsl.source_streams.lsl_stream", counting)
    lab.push(analog(1, 2))
    for _ in range(100):
        lab.push(analog(1, 2, 3))
    assert described == [2, 3]
    lab.now_s += 10
    lab.streams.open_waiting()
    assert [opened["num_channels"] for opened in lab.opened] == [2, 3]
    assert described == [2, 3, 3]


def test_the_stream_of_a_component_that_the_server_no_longer_has_closes(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"))
    lab.set_parameters(Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "C7"),))))
    assert lab.kinds == [(Kind.OPEN, 1), (Kind.OPEN, 2), (Kind.CLOSE, 1)]


def test_streams_stay_while_a_server_gives_no_parameters(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"))
    lab.set_parameters(Parameters())
    lab.set_parameters(with_tools("Probe"))
    assert lab.kinds == [(Kind.OPEN, 1)]


def test_closing_closes_every_stream(lab: Streams) -> None:
    lab.push(analog(1), markers(2))
    lab.streams.close()
    assert {message.stream for message in lab.sent if message.kind is Kind.CLOSE} == {1, 2}
    assert lab.streams.numbers == {}


def test_another_process_gets_the_same_streams(lab: Streams) -> None:
    lab.push(analog(1), markers(2))
    first = [message for message in lab.sent if message.kind is Kind.OPEN]
    before = len(lab.sent)
    lab.streams.reopen()
    assert lab.sent[before:] == first


def test_the_memory_for_slow_receivers_is_bounded(lab: Streams) -> None:
    lab.push(analog(1))
    lab.push(markers(5000))
    [small, large] = lab.opened
    assert small["buffer_s"] == 30
    assert large["buffer_s"] * 100 * 4 * large["num_channels"] <= MAX_BUFFER_BYTES


# What is pushed ----------------------------------------------------------------------------------


def test_equal_frames_are_pushed_together_with_their_capture_times(lab: Streams) -> None:
    lab.push(analog(1, 2))
    [samples] = lab.push(analog(1, 2), count=3)
    assert times_of(samples) == [CAPTURED_S, CAPTURED_S + 0.01, CAPTURED_S + 0.02]
    assert values_of(samples) == [[1, 2]] * 3


def test_many_frames_of_few_items_are_not_pushed_at_once_in_a_stream_of_many_channels(lab: Streams) -> None:
    """A server could so make the gateway fill its memory with NaN."""
    lab.push(markers(10_000))
    messages = lab.push(markers(1), count=60)
    assert [len(times_of(message)) for message in messages] == [25, 25, 10]
    assert len({time_s for message in messages for time_s in times_of(message)}) == 60


def test_only_wanted_streams_and_components_are_pushed(lab: Streams) -> None:
    lab.push(analog(1), markers(1))
    frame = split_frame(encode_frame([analog(1), markers(1)]), "big")
    before = len(lab.sent)
    stamp = Stamp(0, 0, 1, 1)
    lab.streams.push([CapturedFrame(frame, stamp, ALL, 0)], frozenset({2}), 0)
    assert [message.stream for message in lab.sent[before:]] == [2]
    only_analog = frozenset({ComponentType.ANALOG})
    lab.streams.push([CapturedFrame(frame, stamp, only_analog, 0)], frozenset({1, 2}), 0)
    assert [message.stream for message in lab.sent[before:]] == [2, 1]


def test_a_component_that_comes_twice_is_two_samples_at_their_own_times(lab: Streams) -> None:
    lab.push(analog(1))
    first, second = lab.push(analog(1), analog(2, timestamp_us=2_500))
    assert (values_of(first), times_of(first)) == ([[1]], [CAPTURED_S])
    assert (values_of(second), times_of(second)) == ([[2]], [CAPTURED_S + 0.0025])


def test_a_time_stamp_of_another_clock_does_not_count(lab: Streams) -> None:
    lab.push(analog(1))
    _, second = lab.push(analog(1), analog(2, timestamp_us=5_000_000_000))
    assert times_of(second) == [CAPTURED_S]


def test_little_endian_frames_have_the_same_values(lab: Streams) -> None:
    lab.push(analog(1.5))
    assert values_of(lab.push(analog(1.5, order="little"), order="little")[0]) == [[1.5]]


def test_events_are_texts_at_their_own_time(lab: Streams) -> None:
    lab.set_parameters(Parameters(events=ParametersEvents((EventDefinition("7", "Button"),))))
    [message] = lab.push(events(7, 8, timestamp_us=100_000, own_us=97_000))
    assert message.kind is Kind.TEXTS
    times, texts = json.loads(message.content)
    assert texts == ["Button: param1: 3", "event 8: param1: 3"]
    assert times == pytest.approx([CAPTURED_S - 0.003] * 2)


def test_short_events_have_the_time_of_their_frame(lab: Streams) -> None:
    items = np.array([(7, -1, -1, -1)], SHORT_EVENT)
    short = encode_component(ComponentType.EVENT, 1, 0, items)
    lab.push(short)
    times, texts = json.loads(lab.push(short)[0].content)
    assert (times, texts) == ([CAPTURED_S], ["event 7"])


def test_components_without_items_are_no_samples(lab: Streams) -> None:
    lab.push(analog(1), events(7))
    assert lab.push(events()) == []
    [empty] = lab.push(analog())
    assert values_of(empty) == [pytest.approx([np.nan], nan_ok=True)]


# Loss ----------------------------------------------------------------------------------------------


def test_an_unknown_unit_gives_no_positions_and_is_counted(lab: Streams) -> None:
    lab.set_parameters(with_tools("Probe"), CoordinateFrame("lab", None))
    assert lab.sent == []
    lab.push(markers(1), analog(1), count=5)
    assert [opened["name"] for opened in lab.opened] == ["lab_analog"]
    assert lab.lost == {"unknown unit": (10, 10)}


def test_too_many_channels_are_counted(lab: Streams) -> None:
    lab.push(markers(20_000))
    assert lab.sent == []
    assert lab.lost == {"too many channels": (1, 1)}


def test_samples_without_a_process_are_counted(lab: Streams) -> None:
    lab.push(analog(1))
    lab.has_process = False
    lab.push(analog(1), count=3)
    assert lab.lost == {"not open": (3, 3)}
