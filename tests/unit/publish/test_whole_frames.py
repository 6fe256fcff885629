"""Outputs that take whole frames: what they get, how it is counted, and how they close."""

from gateway.errors import OutputError
from gateway.outputs.guard import GuardedOutput
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ComponentType
from tests.support.statuses import amounts
from tests.support.toy_output import ToyOutput
from tests.unit.publish.rig import (
    ALL,
    EVENT,
    FULL,
    MARKERS,
    ONLY_MARKERS,
    STAMP,
    TOOLS,
    FrameOutput,
    frame,
    publish,
    publish_full,
    sequences,
    stamp,
)


def test_frames_without_wanted_components_are_not_published_and_skipped_messages_are_counted() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    fan_out.publish(frame(0), stamp(0), frozenset({EVENT}))  # it has none
    assert fan_out.skip(frame(0), stamp(0), frozenset({EVENT})) == 0
    publish(fan_out, 1)
    assert fan_out.skip(frame(2), stamp(2), ALL) == 2
    publish(fan_out, 3)
    assert [published.body for published, _, _ in output.frames] == [frame(1).body, frame(3).body]


def test_each_frame_arrives_whole_with_its_stamp_and_wanted_components() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    publish_full(fan_out)
    publish_full(fan_out, ONLY_MARKERS)
    assert output.frames == [(FULL, STAMP, ALL), (FULL, STAMP, ONLY_MARKERS)]
    assert output.sources == ["lab"]


def test_no_component_is_published_besides_the_frame() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    publish_full(fan_out)
    output.wanted = {"status"}
    fan_out.publish_status(b"status")
    assert {topic.path for topic in output.declared} == {("status",), ("clock",)}
    assert [message for _, message in output.messages] == [b"status"]


def test_frames_and_their_bytes_are_counted() -> None:
    fan_out = FanOut("lab", [FrameOutput()])
    for _ in range(3):
        publish_full(fan_out)
    [(_, status)] = fan_out.outputs
    assert (status.messages, status.message_bytes) == ({"frame": 3}, {"frame": 3 * len(FULL.body)})


def test_frames_that_nobody_receives_are_neither_published_nor_counted() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    output.received = ONLY_MARKERS
    publish_full(fan_out)
    publish_full(fan_out, ALL - ONLY_MARKERS)
    assert [components for _, _, components in output.frames] == [ALL]
    assert fan_out.outputs[0][1].messages == {"frame": 1}
    assert fan_out.skip(FULL, STAMP, ALL - ONLY_MARKERS) == 0


def test_an_output_prepares_once_for_each_layout_until_something_changes() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    for components in (ALL, ONLY_MARKERS, ALL, frozenset[ComponentType]()):
        for _ in range(3):
            publish_full(fan_out, components)
    assert output.prepared == [(FULL.layout, ALL), (FULL.layout, ONLY_MARKERS)]
    output.received = frozenset()
    output.on_change()
    publish_full(fan_out)
    assert output.prepared[2:] == [(FULL.layout, ALL)]
    assert len(output.frames) == 9


def test_an_output_with_a_defect_in_preparing_gets_the_frames_and_others_are_not_disturbed() -> None:
    broken, healthy = FrameOutput("broken"), FrameOutput("healthy")
    fan_out = FanOut("lab", [GuardedOutput(broken), healthy])
    broken.error = ZeroDivisionError("division by zero")
    publish_full(fan_out)
    assert len(healthy.frames) == 1
    assert amounts(fan_out.outputs[0][1].losses) == {"ZeroDivisionError": (1, 1)}


def test_a_frame_that_is_not_accepted_is_counted_and_the_next_one_is_published() -> None:
    output = FrameOutput()
    fan_out = FanOut("lab", [output])
    for output.error in (None, OutputError("the disk is full", cause="disk full"), None):
        publish_full(fan_out)
    [(_, status)] = fan_out.outputs
    assert (amounts(status.losses), status.messages) == ({"disk full": (1, 1)}, {"frame": 2})


def test_a_replacement_continues_the_counters_and_the_former_one_is_closed() -> None:
    components, before, after = ToyOutput(), FrameOutput(), FrameOutput()
    fan_out = FanOut("lab", [components])
    for output in (components, before, after, components):
        fan_out.set_outputs([output])
        publish_full(fan_out)
        if output is after:
            assert fan_out.outputs[0][1].messages["frame"] == 2
            assert (before.closed, after.closed) == (1, 0)
    assert (len(before.frames), len(after.frames), sequences(components, "3d")) == (1, 1, [0, 3])


def test_losses_that_an_output_counts_itself_outlive_it() -> None:
    before, after = FrameOutput(), FrameOutput()
    fan_out = FanOut("lab", [before])
    before.losses["lab"].lost("malformed request", "what is this?", messages=3, frames=0)
    assert amounts(fan_out.outputs[0][1].losses) == {"malformed request": (3, 0)}
    fan_out.set_outputs([after])
    after.losses["lab"].lost("malformed request", "what is this?", frames=0)
    assert amounts(fan_out.outputs[0][1].losses) == {"malformed request": (4, 0)}


def test_an_output_of_whole_frames_says_which_components_have_subscribers() -> None:
    """A stream on demand whose components nobody wants is stopped at the server."""
    output = FrameOutput()
    output.received = ONLY_MARKERS
    fan_out = FanOut("lab", [output])
    assert fan_out.has_subscribers([MARKERS, TOOLS])
    assert not fan_out.has_subscribers([ComponentType.ANALOG, ComponentType.FORCE])
