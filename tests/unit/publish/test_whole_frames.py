"""Outputs that take whole frames: what they get, how it is numbered and counted, and how they close."""

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.stamp import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import Frame, split_frame
from tests.losses import amounts
from tests.toy_output import ToyOutput
from tests.vectors import FULL_FRAME

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
FULL = split_frame(FULL_FRAME["big"], "big")
ALL = frozenset(WIRE_ORDER)
MARKERS = frozenset({ComponentType.MARKERS})


class FrameOutput(ToyOutput):
    """Takes whole frames. ``frames`` are those that it accepted, ``closed`` counts closed publishers."""

    def __init__(self, name: str = "toy") -> None:
        super().__init__(name)
        self.frames: list[tuple[Frame, Stamp, int, frozenset[ComponentType]]] = []
        self.sources: list[str] = []
        self.closed = 0
        self.losses: dict[str, Losses] = {}

    def frame_publisher(self, source: str) -> "FrameOutputPublisher":
        self.sources.append(source)
        return FrameOutputPublisher(self)

    def count_losses(self, source: str, losses: Losses) -> None:
        self.losses[source] = losses


class FrameOutputPublisher:
    wanted = True

    def __init__(self, output: FrameOutput) -> None:
        self._output = output

    def publish(
        self, frame: Frame, stamp: Stamp, sequence: int, components: frozenset[ComponentType]
    ) -> None:
        if self._output.error is not None:
            raise self._output.error
        self._output.frames.append((frame, stamp, sequence, components))

    def close(self) -> None:
        self._output.closed += 1


def test_each_frame_arrives_whole_with_its_stamp_number_and_wanted_components() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, MARKERS)
    assert output.frames == [(FULL, STAMP, 0, ALL), (FULL, STAMP, 1, MARKERS)]
    assert output.sources == ["lab"]


def test_no_component_is_published_besides_the_frame() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish_status(b"status")
    assert {topic.path for topic in output.declared} == {("status",), ("clock",)}
    assert [message for _, message in output.messages] == [b"status"]


def test_frames_and_their_bytes_are_counted() -> None:
    fan_out = FanOut("lab", [FrameOutput()])
    for _ in range(3):
        fan_out.publish(FULL, STAMP, ALL)
    [(_, status)] = fan_out.outputs
    assert status.messages == {"frame": 3}
    assert status.message_bytes == {"frame": 3 * len(FULL.body)}


def test_a_frame_that_is_not_accepted_is_counted_and_uses_up_its_number() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    for output.error in (None, OutputError("the disk is full", cause="disk full"), None):
        fan_out.publish(FULL, STAMP, ALL)
    [(_, status)] = fan_out.outputs
    assert amounts(status.losses) == {"disk full": (1, 1)}
    assert status.messages == {"frame": 2}
    assert [sequence for _, _, sequence, _ in output.frames] == [0, 2]


def test_a_replacement_continues_the_numbers_and_the_former_one_is_closed() -> None:
    before, after = FrameOutput(), FrameOutput()
    fan_out = FanOut("lab", [before])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.set_outputs([after])
    fan_out.publish(FULL, STAMP, ALL)
    assert [sequence for _, _, sequence, _ in after.frames] == [1]
    assert (before.closed, after.closed) == (1, 0)
    assert fan_out.outputs[0][1].messages == {"frame": 2}


def test_losses_that_an_output_counts_itself_outlive_it() -> None:
    before, after = FrameOutput(), FrameOutput()
    fan_out = FanOut("lab", [before])
    before.losses["lab"].lost("malformed request", "what is this?", messages=3, frames=0)
    assert amounts(fan_out.outputs[0][1].losses) == {"malformed request": (3, 0)}
    fan_out.set_outputs([after])
    after.losses["lab"].lost("malformed request", "what is this?", frames=0)
    assert amounts(fan_out.outputs[0][1].losses) == {"malformed request": (4, 0)}


def test_an_output_of_frames_can_replace_one_of_components() -> None:
    before, after = ToyOutput(), FrameOutput()
    fan_out = FanOut("lab", [before])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.set_outputs([after])
    fan_out.publish(FULL, STAMP, ALL)
    assert [sequence for _, _, sequence, _ in after.frames] == [1]
    fan_out.set_outputs([before])
    fan_out.publish(FULL, STAMP, MARKERS)
    assert len(before.messages) == 6
