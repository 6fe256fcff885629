"""Changing the outputs of a fan-out while frames arrive."""

from gateway.errors import OutputError
from gateway.messages.decode import decode
from gateway.messages.stamp import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from tests.losses import amounts
from tests.server_parameters import in_metres
from tests.toy_output import ToyOutput
from tests.vectors import FULL_FRAME

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
FULL = split_frame(FULL_FRAME["big"], "big")
PROBES = Parameters(tools=Parameters6D(tools=(Tool(id="0", label="Probe"), Tool(id="1", label="Head"))))


def publish(fan_out: FanOut) -> None:
    fan_out.publish(FULL, STAMP, frozenset(WIRE_ORDER))


def sequences(output: ToyOutput, component: str) -> list[int]:
    return [decode(message).sequence for topic, message in output.messages if topic.path == (component,)]


def test_replacing_an_output_does_not_disturb_the_others() -> None:
    stays, before, after = ToyOutput("stays"), ToyOutput("side"), ToyOutput("side")
    fan_out = FanOut("lab", [stays, before])
    declared = list(stays.declared)
    fan_out.set_outputs([stays, after])
    publish(fan_out)
    assert (stays.declared, stays.closed_topics) == (declared, [])
    assert sequences(stays, "3d") == [0]


def test_a_replacement_continues_numbers_and_counters() -> None:
    before, after = ToyOutput("side"), ToyOutput("side")
    fan_out = FanOut("lab", [before])
    publish(fan_out)
    fan_out.set_outputs([after])
    publish(fan_out)
    assert (sequences(before, "3d"), sequences(after, "3d")) == ([0], [1])
    [(output, status)] = fan_out.outputs
    assert output is after
    assert status.messages["3d"] == 2
    assert status.message_bytes["3d"] == sum(
        len(message) for topic, message in (*before.messages, *after.messages) if topic.path == ("3d",)
    )


def test_a_replacement_continues_the_counts_of_what_was_lost() -> None:
    before, after = ToyOutput("side"), ToyOutput("side")
    before.error = after.error = OutputError("no router", cause="no router")
    fan_out = FanOut("lab", [before])
    fan_out.publish_status(b"status")
    fan_out.set_outputs([after])
    fan_out.publish_status(b"status")
    [(_, status)] = fan_out.outputs
    assert amounts(status.losses) == {"no router": (2, 0)}


def test_status_and_clock_are_counted_under_their_own_names() -> None:
    fan_out = FanOut("lab", [ToyOutput()])
    fan_out.publish_status(b"status")
    fan_out.publish_clock(b"clock")
    [(_, status)] = fan_out.outputs
    assert (status.messages, status.message_bytes) == ({"status": 1, "clock": 1}, {"status": 6, "clock": 5})


def test_removing_an_output_closes_everything_declared_on_it() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    declared = list(output.declared)
    fan_out.set_outputs([])
    publish(fan_out)
    assert (output.declared, output.announced, output.messages) == ([], [], [])
    assert sorted(output.closed_topics) == sorted(declared)


def test_an_output_that_comes_back_continues_its_numbers() -> None:
    fan_out = FanOut("lab", [ToyOutput("side")])
    publish(fan_out)
    fan_out.set_outputs([])
    again = ToyOutput("side")
    fan_out.set_outputs([again])
    publish(fan_out)
    assert sequences(again, "3d") == [1]


def test_a_new_output_shows_that_frames_arrive() -> None:
    fan_out = FanOut("lab", [ToyOutput("one")])
    fan_out.show_streaming(True)
    new = ToyOutput("two")
    fan_out.set_outputs([new])
    assert (new.announced, new.streaming) == (["lab"], [True])


def test_a_closed_fan_out_leaves_nothing_declared() -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(PROBES))
    fan_out.show_streaming(True)
    publish(fan_out)
    fan_out.close()
    assert (output.declared, output.announced, output.streaming) == ([], [], [True, False])


def test_tool_topics_stay_open_on_an_output_that_stays() -> None:
    stays, before, after = (
        ToyOutput(name, "Probe", has_tool_poses=True) for name in ("stays", "side", "side")
    )
    fan_out = FanOut("lab", [stays, before])
    fan_out.set_parameters(in_metres(PROBES))
    publish(fan_out)
    fan_out.set_outputs([stays, after])
    publish(fan_out)
    assert stays.closed_topics == []
    assert [len(output.poses("Probe")) for output in (stays, before, after)] == [2, 1, 1]
    assert [pose.sequence for pose in stays.poses("Probe")] == [0, 1]
    assert before.tool_names() == []


def test_tool_topics_are_closed_where_they_are_switched_off() -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(PROBES))
    publish(fan_out)
    output.has_tool_poses = False
    fan_out.set_outputs([output])
    publish(fan_out)
    assert output.tool_names() == []
    assert len(output.poses("Probe")) == 1
    assert sequences(output, "3d") == [0, 1]
