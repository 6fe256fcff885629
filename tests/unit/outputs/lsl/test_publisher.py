"""The publisher of one source's frames: which streams it opens, and which frames are wanted."""

import itertools

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import ServerParameters
from gateway.outputs.lsl.publisher import MAX_WAITING, LslFramePublisher
from gateway.outputs.lsl.settings import LslSettings
from gateway.outputs.lsl.source_streams import SourceStreams
from gateway.outputs.lsl.supervisor import LslProcesses
from gateway.outputs.lsl.wire import Kind, Message, Report
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ComponentType, encode_component
from gateway.rtc3d.frames import Frame, encode_frame, split_frame
from tests.losses import amounts

ALL = frozenset(WIRE_ORDER)
MARKERS, ANALOG = ComponentType.MARKERS, ComponentType.ANALOG
STAMP = Stamp(0, 0, 1, 1)


class Lab:
    """A publisher, and a process for LSL of which the test says who receives."""

    def __init__(self) -> None:
        self.sent: list[Message] = []
        self.changes = 0
        self.processes = LslProcesses(LslSettings(enabled=True), self._changed)
        self.streams = SourceStreams("lab", "lab-pc", 30, itertools.count(1), self._send)
        self.publisher = LslFramePublisher(self.streams, self.processes, nothing, lambda _: None)
        self.publisher.on_change = self._changed
        self.processes._socket = object()  # type: ignore[assignment]  # as if a process ran
        self.receive()

    def _send(self, message: Message) -> bool:
        self.sent.append(message)
        return True

    def _changed(self) -> None:
        self.changes += 1

    def receive(self, *components: ComponentType) -> None:
        """Have a receiver of the streams of these components, and of no others."""
        wanted = tuple(self.streams.numbers[each] for each in components)
        self.processes._take(Report(ready="118", wanted=wanted))

    def prepare(self, frame: Frame) -> bool:
        is_wanted = self.publisher.prepare(frame.layout, ALL)
        self.publisher.send_waiting(0)
        return is_wanted

    @property
    def kinds(self) -> list[Kind]:
        return [message.kind for message in self.sent]


def nothing() -> None:
    """The tests call ``send_waiting`` themselves."""


def frame_with(*components: tuple[ComponentType, int]) -> Frame:
    encoded = [encode_component(each, 1, 0, np.zeros(count, ITEM_DTYPES[each])) for each, count in components]
    return split_frame(encode_frame(encoded), "big")


@pytest.fixture
def lab() -> Lab:
    return Lab()


def test_a_frame_is_wanted_if_somebody_receives_one_of_its_streams(lab: Lab) -> None:
    both, analog = frame_with((MARKERS, 3), (ANALOG, 2)), frame_with((ANALOG, 2))
    assert not lab.prepare(both)
    assert lab.kinds == [Kind.OPEN, Kind.OPEN]
    lab.receive(MARKERS)
    assert lab.changes == 1
    assert lab.prepare(both)
    assert not lab.publisher.prepare(both.layout, ALL - {MARKERS})
    assert not lab.prepare(analog)


def test_streams_open_for_the_most_items_without_any_receiver(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.outputs.lsl.source_streams.MIN_LIFE_S", 0.0)
    for count in (2, 3, 2, 3, 1):
        lab.prepare(frame_with((ANALOG, count)))
    lab.prepare(frame_with((ANALOG, 1), (ANALOG, 4)))
    assert lab.kinds == [Kind.OPEN, *(2 * [Kind.CLOSE, Kind.OPEN])]
    assert lab.streams._streams[ANALOG].num_items == 4


def test_other_parameters_make_the_publisher_learn_the_layouts_again(lab: Lab) -> None:
    lab.prepare(frame_with((ANALOG, 2)))
    lab.publisher.set_parameters(ServerParameters(b"", 1, 2, frame=CoordinateFrame("lab")))
    assert lab.changes == 1
    lab.prepare(frame_with((ANALOG, 2)))
    assert lab.streams._streams[ANALOG].version == 1


def test_frames_of_received_streams_are_refused_until_the_next_process_is_ready(lab: Lab) -> None:
    frame = frame_with((MARKERS, 3))
    lab.prepare(frame)
    lab.receive(MARKERS)
    lab.publisher.publish(frame, STAMP, 0, ALL)
    lab.processes._report = Report()
    assert lab.prepare(frame)
    with pytest.raises(OutputError, match="LSL: ") as refused:
        lab.publisher.publish(frame, STAMP, 1, ALL)
    assert refused.value.cause == "not open"
    assert amounts(lab.streams.losses.report()) == {"not open": (1, 1)}
    lab.receive()
    assert not lab.prepare(frame)


def test_what_waits_for_the_thread_is_bounded(lab: Lab) -> None:
    frame = frame_with((MARKERS, 3))
    for number in range(MAX_WAITING):
        lab.publisher.publish(frame, STAMP, number, ALL)
    with pytest.raises(OutputError, match="too busy") as refused:
        lab.publisher.publish(frame, STAMP, MAX_WAITING, ALL)
    assert refused.value.cause == "queue full"


def test_streams_open_although_too_many_frames_wait(lab: Lab) -> None:
    frame = frame_with((MARKERS, 3))
    for number in range(MAX_WAITING):
        lab.publisher.publish(frame, STAMP, number, ALL)
    lab.prepare(frame_with((ANALOG, 2)))
    assert ANALOG in lab.streams.numbers


def test_a_closed_publisher_takes_nothing(lab: Lab) -> None:
    frame = frame_with((MARKERS, 3))
    lab.publisher.close()
    assert not lab.prepare(frame)
    assert lab.sent == []
    with pytest.raises(OutputError, match="ask for a new publisher"):
        lab.publisher.publish(frame, STAMP, 0, ALL)
