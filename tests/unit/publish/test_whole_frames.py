"""Outputs that take whole frames: what they get, how it is numbered and counted, and how they close."""

from collections.abc import Callable, Collection

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.messages.stamp import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import Frame, FrameLayout, split_frame
from tests.losses import amounts
from tests.toy_output import ToyOutput
from tests.vectors import FULL_FRAME

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
FULL = split_frame(FULL_FRAME["big"], "big")
ALL = frozenset(WIRE_ORDER)
MARKERS = frozenset({ComponentType.MARKERS})


class FrameOutput(ToyOutput):
    """Takes whole frames, if they have one of the components in ``received``.

    ``frames`` are those that it accepted, ``prepared`` the layouts and components that it was asked for,
    ``closed`` counts closed publishers, and ``on_change`` is what it has to call when ``received`` changes.
    """

    def __init__(self, name: str = "toy") -> None:
        super().__init__(name)
        self.received = ALL
        self.prepared: list[tuple[FrameLayout, frozenset[ComponentType]]] = []
        self.on_change: Callable[[], None] = lambda: None
        self.frames: list[tuple[Frame, Stamp, int, frozenset[ComponentType]]] = []
        self.sources: list[str] = []
        self.closed = 0
        self.losses: dict[str, Losses] = {}

    def frame_publisher(self, source: str) -> "FrameOutputPublisher":
        self.sources.append(source)
        return FrameOutputPublisher(self)

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:  # noqa: ARG002 - one source
        self.on_change = on_change
        return True

    def count_losses(self, source: str, losses: Losses) -> None:
        self.losses[source] = losses


class FrameOutputPublisher:
    def __init__(self, output: FrameOutput) -> None:
        self._output = output

    def wants(self, components: Collection[ComponentType]) -> bool:
        return not self._output.received.isdisjoint(components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        self._output.prepared.append((layout, components))
        if isinstance(self._output.error, ZeroDivisionError):
            raise self._output.error
        return not components.isdisjoint(self._output.received)

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
    output.wanted = {"status"}
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


def test_frames_that_nobody_receives_are_neither_published_nor_counted() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    output.received = MARKERS
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, ALL - MARKERS)
    assert [components for _, _, _, components in output.frames] == [ALL]
    assert fan_out.outputs[0][1].messages == {"frame": 1}
    assert fan_out.skip(FULL, STAMP, ALL - MARKERS) == 0


def test_an_output_prepares_once_for_each_layout_until_something_changes() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    for components in (ALL, MARKERS, ALL, frozenset[ComponentType]()):
        for _ in range(3):
            fan_out.publish(FULL, STAMP, components)
    assert output.prepared == [(FULL.layout, ALL), (FULL.layout, MARKERS)]
    output.received = frozenset()
    output.on_change()
    fan_out.publish(FULL, STAMP, ALL)
    assert output.prepared[2:] == [(FULL.layout, ALL)]
    assert len(output.frames) == 9


def test_an_output_with_a_defect_in_preparing_gets_the_frames_and_others_are_not_disturbed() -> None:
    broken, healthy = FrameOutput("broken"), FrameOutput("healthy")
    fan_out = FanOut("lab", [broken, healthy])
    broken.error = ZeroDivisionError("division by zero")
    fan_out.publish(FULL, STAMP, ALL)
    assert len(healthy.frames) == 1
    assert amounts(fan_out.outputs[0][1].losses) == {"ZeroDivisionError": (1, 1)}


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


def test_an_output_of_whole_frames_says_which_components_have_subscribers() -> None:
    """A stream on demand whose components nobody wants is stopped at the server."""
    output = FrameOutput()
    output.received = frozenset({ComponentType.MARKERS})
    fan_out = FanOut("lab", [output])
    assert fan_out.has_subscribers([ComponentType.MARKERS, ComponentType.TOOLS])
    assert not fan_out.has_subscribers([ComponentType.ANALOG, ComponentType.FORCE])
