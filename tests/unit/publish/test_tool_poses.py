import logging
import struct
from collections.abc import Sequence
from itertools import chain

import pytest

from gateway.messages.stamp import Stamp
from gateway.messages.topics import Topic
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER
from gateway.rtc3d.frames import Frame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters3D, Parameters6D, Tool
from tests.losses import amounts
from tests.server_parameters import in_metres
from tests.toy_output import ToyOutput

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
ALL = frozenset(WIRE_ORDER)
IN_VIEW = (1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.5)


def tools_frame(*poses: Sequence[float]) -> Frame:
    """Return a frame with one 6D component; each pose is q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIIiqI", 1, 24 + 32 * len(poses), 4, 7, 7000, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    return split_frame(wire, "big")


def parameters(*labels: str, unit: str = "mm") -> Parameters:
    tools = tuple(Tool(id=str(number), label=label) for number, label in enumerate(labels))
    return Parameters(markers=Parameters3D(unit=unit), tools=Parameters6D(tools=tools))


def publish_tools(fan_out: FanOut, count: int) -> None:
    fan_out.publish(tools_frame(*[IN_VIEW] * count), STAMP, ALL)


def test_tools_have_topics_only_where_switched_on() -> None:
    with_tools, without = ToyOutput("with", "Probe", has_tool_poses=True), ToyOutput("without", "Probe")
    fan_out = FanOut("lab", [with_tools, without])
    fan_out.set_parameters(in_metres(parameters("Probe")))
    publish_tools(fan_out, 1)
    [(topic, _)] = [each for each in with_tools.messages if len(each[0].path) == 2]
    assert topic == Topic("lab", ("6d", "Probe"), "rtc3d.tool_pose_t")
    assert without.tool_names() == []


def test_a_pose_is_published_while_it_has_a_subscriber() -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("Probe", "Head")))
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
        ([500 * "x", 500 * "x"], [200 * "x", 198 * "x" + "_2"]),
    ],
)
def test_topics_are_named_after_the_labels(labels: list[str], names: list[str]) -> None:
    output = ToyOutput(has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters(*labels)))
    publish_tools(fan_out, len(names))
    assert output.tool_names() == names


def test_tools_without_parameters_are_numbered() -> None:
    output = ToyOutput(has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(Parameters()))
    publish_tools(fan_out, 2)
    assert output.tool_names() == ["tool 1", "tool 2"]


def test_new_labels_replace_the_topics() -> None:
    output = ToyOutput(has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("Probe", "Head")))
    publish_tools(fan_out, 2)
    fan_out.set_parameters(in_metres(parameters("Head", "Foot", "Hand")))
    publish_tools(fan_out, 3)
    assert output.tool_names() == ["Head", "Foot", "Hand"]


def test_topics_stay_open_while_the_labels_stay() -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    for session in (1, 2):
        fan_out.set_parameters(in_metres(parameters("Probe")))
        fan_out.publish(tools_frame(IN_VIEW), Stamp(STAMP.utime, STAMP.capture_utime, session, 1), ALL)
    counted = [(pose.sequence, pose.session) for pose in output.poses("Probe")]
    assert counted == [(0, 1), (1, 2)]
    assert output.closed_topics == []


def test_a_tool_that_keeps_its_label_continues_its_numbers() -> None:
    output = ToyOutput("toy", "Probe", "Head", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    for labels in (["Probe"], ["Head", "Probe"], ["Head", "Probe"]):
        fan_out.set_parameters(in_metres(parameters(*labels)))
        publish_tools(fan_out, len(labels))
    assert [pose.sequence for pose in output.poses("Probe")] == [0, 1, 2]
    assert [pose.sequence for pose in output.poses("Head")] == [0, 1]


def test_of_more_than_1024_names_those_that_were_used_last_keep_their_numbers() -> None:
    """Whoever watches a tool sees no loss where there is none; names of long ago must not fill the memory."""
    output = ToyOutput("toy", "0-0", "1-0", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    for group in (0, 1, 2, 3, 0, 4, 0, 1):
        fan_out.set_parameters(in_metres(parameters(*(f"{group}-{number}" for number in range(256)))))
        publish_tools(fan_out, 256)
    assert [pose.sequence for pose in output.poses("0-0")] == [0, 1, 2]
    assert [pose.sequence for pose in output.poses("1-0")] == [0, 0]


def test_a_number_of_tools_that_goes_up_and_down_reopens_no_topic() -> None:
    output = ToyOutput("toy", "A", "B", "C", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("A", "B", "C")))
    publish_tools(fan_out, 3)
    for count in (1, 0, 3, 2):
        publish_tools(fan_out, count)
    assert (output.tool_names(), output.closed_topics) == (["A", "B", "C"], [])
    counted = {name: [pose.sequence for pose in output.poses(name)] for name in "ABC"}
    assert counted == {"A": [0, 1, 2, 3], "B": [0, 1, 2], "C": [0, 1]}


def test_too_many_tools_get_no_topics_and_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    output = ToyOutput("toy", "tool 1", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    for _ in range(2):
        publish_tools(fan_out, 257)
    assert output.tool_names() == []
    assert amounts(fan_out.outputs[0][1].losses) == {"too many tools": (514, 2)}
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert fan_out.outputs[0][1].messages == {"6d": 2}
    publish_tools(fan_out, 256)
    assert len(output.tool_names()) == 256


@pytest.mark.parametrize(
    ("unit", "position_m"), [("mm", (0.1, 0.2, 0.3)), ("m", (100.0, 200.0, 300.0)), ("", (0.1, 0.2, 0.3))]
)
def test_poses_are_in_metres_whatever_the_unit_of_the_server(
    unit: str, position_m: tuple[float, ...]
) -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("Probe", unit=unit)))
    publish_tools(fan_out, 1)
    assert output.poses("Probe")[0].position_m == pytest.approx(position_m)


def test_an_unknown_unit_is_logged_and_no_pose_is_published(caplog: pytest.LogCaptureFixture) -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("Probe", unit="furlong")))
    publish_tools(fan_out, 1)
    assert output.poses("Probe") == []
    assert amounts(fan_out.outputs[0][1].losses) == {"unknown unit": (1, 1)}
    assert ["furlong" in record.getMessage() for record in caplog.records] == [True]


def test_an_unknown_unit_is_not_logged_without_tool_poses(caplog: pytest.LogCaptureFixture) -> None:
    FanOut("lab", [ToyOutput()]).set_parameters(in_metres(parameters("Probe", unit="furlong")))
    assert not caplog.records


def test_without_parameters_poses_are_converted_from_millimetres() -> None:
    output = ToyOutput("toy", "tool 1", has_tool_poses=True)
    publish_tools(FanOut("lab", [output]), 1)
    [pose] = output.poses("tool 1")
    assert pose.position_m == pytest.approx((0.1, 0.2, 0.3))


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


def test_topics_stay_open_when_tools_are_added() -> None:
    output = ToyOutput("toy", "tool 1", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    publish_tools(fan_out, 1)
    before = set(output.tool_names())
    publish_tools(fan_out, 3)
    assert before == {"tool 1"}
    assert sorted(output.tool_names()) == ["tool 1", "tool 2", "tool 3"]


def test_no_tool_has_the_name_of_the_key_with_json() -> None:
    output = ToyOutput(has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(in_metres(parameters("json", "JSON", "json")))
    publish_tools(fan_out, 3)
    assert output.tool_names() == ["json_2", "JSON", "json_3"]
