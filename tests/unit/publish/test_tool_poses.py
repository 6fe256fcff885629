import logging
import struct
from collections.abc import Sequence
from itertools import chain

import pytest

from gateway.messages.encode import Stamp
from gateway.messages.history import WantedMessages
from gateway.messages.topics import Topic
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.frames import RawFrame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters3D, Parameters6D, Tool
from gateway.runtime.losses import counts_text
from tests.support.errors import names
from tests.support.parameters import in_metres
from tests.support.records import kinds
from tests.support.statuses import amounts
from tests.support.toy_output import ToyOutput
from tests.unit.publish.rig import ALL, STAMP

IN_VIEW = (1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.5)


def tools_frame(*poses: Sequence[float]) -> RawFrame:
    """Return a frame with one 6D component; each pose is q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIIiqI", 1, 24 + 32 * len(poses), 4, 7, 7000, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    return split_frame(wire, "big")


def parameters(*labels: str, unit: str = "mm") -> Parameters:
    tools = tuple(Tool(id=str(number), label=label) for number, label in enumerate(labels))
    return Parameters(markers=Parameters3D(unit=unit), tools=Parameters6D(tools=tools))


def publish_tools(fan_out: FanOut, count: int) -> None:
    fan_out.publish(tools_frame(*[IN_VIEW] * count), STAMP, ALL)


def lab(
    *labels: str, wanted: tuple[str, ...] = (), unit: str = "mm", has_tool_poses: bool = True
) -> tuple[ToyOutput, FanOut]:
    """Return an output with subscribers of these tools, and a fan-out with parameters of these labels."""
    output = ToyOutput("toy", *wanted, has_tool_poses=has_tool_poses)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters(*labels, unit=unit)))
    return output, fan_out


def test_tools_have_topics_only_where_switched_on() -> None:
    with_tools, without = ToyOutput("with", "Probe", has_tool_poses=True), ToyOutput("without", "Probe")
    fan_out = FanOut("lab", [with_tools, without])
    fan_out.set_parameters(in_metres(parameters("Probe")))
    publish_tools(fan_out, 1)
    [(topic, _)] = [each for each in with_tools.messages if len(each[0].path) == 2]
    assert topic == Topic("lab", ("6d", "Probe"), "rtc3d.tool_pose_t")
    assert without.tool_names() == []


async def test_the_history_has_the_poses_of_tools_that_were_published() -> None:
    output, fan_out = lab("Probe", "Head", wanted=("Probe",))
    fan_out.history.set_limits(60, 1 << 20)
    publish_tools(fan_out, 2)
    publish_tools(fan_out, 2)
    assert await fan_out.find("6d/Head", "toy", WantedMessages(0)) is None
    found = await fan_out.find("6d/Probe", "toy", WantedMessages(0))
    assert found is not None
    published = [message for topic, message in output.messages if topic.path == ("6d", "Probe")]
    assert list(found.messages) == published
    assert len(published) == 2


def test_a_pose_is_published_while_it_has_a_subscriber() -> None:
    output, fan_out = lab("Probe", "Head", wanted=("Probe",))
    publish_tools(fan_out, 2)
    assert (len(output.poses("Probe")), len(output.poses("Head"))) == (1, 0)
    output.wanted = {"Head"}
    publish_tools(fan_out, 2)
    assert (len(output.poses("Probe")), len(output.poses("Head"))) == (1, 1)
    output.wanted = set()
    publish_tools(fan_out, 2)
    assert (len(output.poses("Probe")), len(output.poses("Head"))) == (1, 1)
    assert dict(fan_out.outputs[0][1].messages) == {"6d": 3, "6d/tool": 2}


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (["Probe", "Head"], ["Probe", "Head"]),
        (["Probe", "Probe", "Probe"], ["Probe", "Probe_2", "Probe_3"]),
        ([" Probe ", "  ", ""], ["Probe", "tool 2", "tool 3"]),
        (["Probe"], ["Probe", "tool 2"]),
        ([], ["tool 1"]),
        (["json", "JSON", "json"], ["json_2", "JSON", "json_3"]),
        ([500 * "x", 500 * "x"], [200 * "x", 198 * "x" + "_2"]),
    ],
)
def test_topics_are_named_after_the_labels(labels: list[str], names: list[str]) -> None:
    output, fan_out = lab(*labels)
    publish_tools(fan_out, len(names))
    assert output.tool_names() == names


def test_new_labels_replace_the_topics() -> None:
    output, fan_out = lab("Probe", "Head")
    publish_tools(fan_out, 2)
    fan_out.set_parameters(in_metres(parameters("Head", "Foot", "Hand")))
    publish_tools(fan_out, 3)
    assert output.tool_names() == ["Head", "Foot", "Hand"]


def test_topics_stay_open_while_the_labels_stay() -> None:
    output, fan_out = lab(wanted=("Probe",))
    for session in (1, 2):
        fan_out.set_parameters(in_metres(parameters("Probe")))
        fan_out.publish(tools_frame(IN_VIEW), Stamp(STAMP.utime, STAMP.capture_utime, session, 1), ALL)
    counted = [(pose.sequence, pose.session) for pose in output.poses("Probe")]
    assert counted == [(0, 1), (1, 2)]
    assert output.closed_topics == []


def test_a_tool_that_keeps_its_label_continues_its_numbers() -> None:
    output, fan_out = lab(wanted=("Probe", "Head"))
    for labels in (["Probe"], ["Head", "Probe"], ["Head", "Probe"]):
        fan_out.set_parameters(in_metres(parameters(*labels)))
        publish_tools(fan_out, len(labels))
    assert [pose.sequence for pose in output.poses("Probe")] == [0, 1, 2]
    assert [pose.sequence for pose in output.poses("Head")] == [0, 1]


def test_of_more_than_1024_names_those_that_were_used_last_keep_their_numbers() -> None:
    """Whoever watches a tool sees no loss where there is none; names of long ago must not fill the memory."""
    output, fan_out = lab(wanted=("0-0", "1-0"))
    for group in (0, 1, 2, 3, 0, 4, 0, 1):
        fan_out.set_parameters(in_metres(parameters(*(f"{group}-{number}" for number in range(256)))))
        publish_tools(fan_out, 256)
    assert [pose.sequence for pose in output.poses("0-0")] == [0, 1, 2]
    assert [pose.sequence for pose in output.poses("1-0")] == [0, 0]


def test_a_number_of_tools_that_goes_up_and_down_reopens_no_topic() -> None:
    output, fan_out = lab("A", "B", "C", wanted=("A", "B", "C"))
    publish_tools(fan_out, 3)
    for count in (1, 0, 3, 2):
        publish_tools(fan_out, count)
    assert (output.tool_names(), output.closed_topics) == (["A", "B", "C"], [])
    counted = {name: [pose.sequence for pose in output.poses(name)] for name in "ABC"}
    assert counted == {"A": [0, 1, 2, 3], "B": [0, 1, 2], "C": [0, 1]}


def test_the_tools_of_all_6d_components_of_a_frame_count() -> None:
    """So one frame costs no more poses than one with the largest number of tools."""
    output = ToyOutput("toy", "tool 1", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    component = tools_frame(*[IN_VIEW] * 100).body[4:]
    for count, published in ((2, 2), (3, 2)):
        fan_out.publish(split_frame(count.to_bytes(4, "big") + component * count, "big"), STAMP, ALL)
        assert len(output.poses("tool 1")) == published
    [loss] = fan_out.outputs[0][1].losses
    assert (loss.cause, loss.messages) == ("too many tools", 300)


def test_without_parameters_tools_are_numbered_and_poses_converted_from_millimetres(
    caplog: pytest.LogCaptureFixture,
) -> None:
    for has_parameters in (False, True):
        output = ToyOutput("toy", "tool 1", has_tool_poses=True)
        fan_out = FanOut("lab", [output])
        if has_parameters:
            fan_out.set_parameters(in_metres(Parameters()))
        publish_tools(fan_out, 1)
        assert output.poses("tool 1")[0].position_m == pytest.approx((0.1, 0.2, 0.3))
        publish_tools(fan_out, 3)
        assert (output.tool_names(), output.closed_topics) == (["tool 1", "tool 2", "tool 3"], [])
    assert not caplog.records


# What is not published -----------------------------------------------------------------------


def test_too_many_tools_get_no_topics_and_are_logged_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    output, fan_out = lab(wanted=("tool 1",))
    for _ in range(2):
        publish_tools(fan_out, 257)
    assert output.tool_names() == []
    assert amounts(fan_out.outputs[0][1].losses) == {"too many tools": (514, 2)}
    assert fan_out.outputs[0][1].messages == {"6d": 2}
    publish_tools(fan_out, 256)
    assert len(output.tool_names()) == 256
    fan_out.close()
    assert kinds(caplog) == [("WARNING", "too many tools")]
    began, ended = caplog.messages
    assert names(began, "lab to toy", 257, 256)
    assert names(ended, "lab to toy", counts_text([("too many tools", 514, 2)]))


def test_with_an_unknown_unit_no_pose_is_published_which_is_logged_and_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    output, fan_out = lab("Probe", wanted=("Probe",), unit="x" * 41)
    publish_tools(fan_out, 2)
    publish_tools(fan_out, 0)
    assert output.poses("Probe") == []
    assert amounts(fan_out.outputs[0][1].losses) == {"unknown unit": (2, 1)}
    fan_out.set_parameters(in_metres(parameters("Probe", unit="m")))
    publish_tools(fan_out, 2)
    fan_out.close()
    assert kinds(caplog) == [("WARNING", "unknown unit")]
    began, ended = caplog.messages
    assert names(began, "lab to toy", f"'{'x' * 40}'", "transform.units")
    assert names(ended, "lab to toy", counts_text([("unknown unit", 2, 1)]))


def test_poses_that_are_lost_leave_a_gap_and_too_many_tools_do_not() -> None:
    output, fan_out = lab("Probe", wanted=("Probe",))
    for unit in ("mm", "furlong", "m"):
        fan_out.set_parameters(in_metres(parameters("Probe", unit=unit)))
        publish_tools(fan_out, 1)
    fan_out.skip(tools_frame(*[IN_VIEW] * 257), STAMP, ALL)
    publish_tools(fan_out, 1)
    assert [pose.sequence for pose in output.poses("Probe")] == [0, 2, 3]


def test_poses_of_a_server_without_parameters_are_in_the_configured_frame() -> None:
    output, fan_out = lab(wanted=("tool 1",))
    fan_out.begin(in_metres(Parameters(markers=Parameters3D(unit="m"))))
    publish_tools(fan_out, 1)
    assert output.poses("tool 1")[0].position_m == (100.0, 200.0, 300.0)


def test_an_unknown_unit_is_not_logged_without_tool_poses(caplog: pytest.LogCaptureFixture) -> None:
    lab("Probe", unit="furlong", has_tool_poses=False)
    assert not caplog.records
