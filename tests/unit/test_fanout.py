import logging
import struct
from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np
import pytest

from gateway.decode import decode
from gateway.errors import OutputError
from gateway.fanout import FanOut
from gateway.message import Stamp, splice
from gateway.names import Topic
from gateway.outputs.memory_output import MemoryOutput
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    WIRE_ORDER,
    ComponentType,
    Frame,
    build_component,
    build_frame,
    split_frame,
)
from gateway.rtc3d.parameters import Parameters, Parameters3D, Parameters6D, Tool
from gateway.status import OutputHealth
from tests.vectors import EMPTY_FRAME, FULL_FRAME

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1)
ALL = frozenset(WIRE_ORDER)
FULL = split_frame(FULL_FRAME["big"], "big")
IN_VIEW = (1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.5)


class ToyOutput:
    """Raises ``error`` while there is one; ``listened`` holds the last parts of topics somebody hears."""

    def __init__(self, name: str = "toy", *listened: str) -> None:
        self.name = name
        self.max_rate_hz: dict[ComponentType, float] = {}
        self.flowing: list[bool] = []
        self.listened = set(listened)
        self.error: Exception | None = None
        self.declared: list[Topic] = []
        self.given_up: list[Topic] = []
        self.messages: list[tuple[Topic, bytes]] = []
        self.announced: list[str] = []

    def start(self) -> None: ...

    def publisher(self, topic: Topic) -> "ToyPublisher":
        self.declared.append(topic)
        return ToyPublisher(self, topic)

    def announce(self, source: str) -> None:
        self.announced.append(source)

    def show_flowing(self, _source: str, flowing: bool) -> None:
        self.flowing.append(flowing)

    def maintain(self) -> None: ...

    def health(self) -> OutputHealth:
        return OutputHealth(True)

    def close(self) -> None: ...

    def tool_names(self) -> list[str]:
        """Return the names of the tools that have a topic now."""
        return [topic.parts[1] for topic in self.declared if len(topic.parts) == 2]

    def poses(self, name: str) -> list[Any]:
        """Return the decoded messages of one tool."""
        return [decode(message) for topic, message in self.messages if topic.parts == ("6d", name)]


class ToyPublisher:
    def __init__(self, output: ToyOutput, topic: Topic) -> None:
        self._output = output
        self._topic = topic

    @property
    def wanted(self) -> bool:
        return self._topic.parts[-1] in self._output.listened

    def publish(self, message: bytes) -> None:
        if self._output.error is not None:
            raise self._output.error
        self._output.messages.append((self._topic, message))

    def close(self) -> None:
        self._output.declared.remove(self._topic)
        self._output.given_up.append(self._topic)


@pytest.fixture
def memory() -> MemoryOutput:
    output = MemoryOutput()
    output.start()
    return output


def tools_frame(*poses: Sequence[float]) -> Frame:
    """Return a frame with one 6D component: of each tool q0, qx, qy, qz, x, y, z, error."""
    wire = struct.pack(">IIIiqI", 1, 24 + 32 * len(poses), 4, 7, 7000, len(poses))
    wire += struct.pack(f">{8 * len(poses)}f", *chain.from_iterable(poses))
    return split_frame(wire, "big")


def parameters(*labels: str, unit: str = "mm") -> Parameters:
    tools = tuple(Tool(id=str(number), label=label) for number, label in enumerate(labels))
    return Parameters(markers=Parameters3D(unit=unit), tools=Parameters6D(tools=tools))


# Components ----------------------------------------------------------------------------------


def test_every_component_goes_to_every_output_under_its_topic() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    FanOut("lab", outputs).publish(FULL, STAMP, ALL)
    names = {1: "markers_t", 2: "analog_t", 3: "forces_t", 4: "tools_t", 5: "events_t"}
    expected = [
        (Topic("lab", (component.type.key,), f"rtc3d.{names[component.type]}"), splice(component, STAMP, 0))
        for component in FULL.components
    ]
    assert len(expected) == 5
    assert [output.messages for output in outputs] == [expected, expected]


def test_all_topics_are_declared_before_the_first_frame() -> None:
    output = ToyOutput()
    FanOut("lab", [output])
    assert {topic.parts for topic in output.declared} == {
        ("3d",), ("6d",), ("analog",), ("force",), ("event",), ("status",), ("clock",),
    }  # fmt: skip
    assert {topic.source for topic in output.declared} == {"lab"}


def test_the_source_is_announced_on_every_output() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    FanOut("lab", outputs)
    assert [output.announced for output in outputs] == [["lab"], ["lab"]]


def test_each_component_counts_for_itself_and_across_sessions(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, {ComponentType.MARKERS})
    fan_out.publish(FULL, STAMP._replace(session=2), ALL)
    messages = [(topic.parts, decode(message)) for topic, message in memory.messages]
    counted = {
        key: [(message.sequence, message.session) for parts, message in messages if parts == (key,)]
        for key in ("3d", "analog")
    }
    assert counted == {"3d": [(0, 1), (1, 1), (2, 2)], "analog": [(0, 1), (1, 2)]}


def test_components_that_the_stream_does_not_want_are_not_published(memory: MemoryOutput) -> None:
    FanOut("lab", [memory]).publish(FULL, STAMP, {ComponentType.TOOLS, ComponentType.EVENT})
    assert [topic.parts for topic, _ in memory.messages] == [("6d",), ("event",)]


def test_an_empty_frame_publishes_nothing(memory: MemoryOutput) -> None:
    FanOut("lab", [memory]).publish(split_frame(EMPTY_FRAME["big"], "big"), STAMP, ALL)
    assert not memory.messages


def test_the_newest_message_of_each_component_is_kept(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, {ComponentType.MARKERS})
    newest = {kind.key: decode(message).sequence for kind, message in fan_out.newest.items()}
    assert newest == {"3d": 1, "6d": 0, "analog": 0, "force": 0, "event": 0}


def test_status_and_clock_messages_have_topics_of_their_own(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish_status(b"status")
    assert memory.messages[-1] == (Topic("lab", ("status",), "rtc3d.status_t"), b"status")


# Failing outputs -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "cause"),
    [(OutputError("no router", cause="no router"), "no router"), (ValueError("a defect"), "ValueError")],
)
def test_an_output_that_raises_is_counted_and_stops_no_other(error: Exception, cause: str) -> None:
    broken, good = ToyOutput("broken"), ToyOutput("good")
    broken.error = error
    fan_out = FanOut("lab", [broken, good])
    for _ in range(2):
        fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish_status(b"status")
    statuses = {output.name: status for output, status in fan_out.outputs}
    assert statuses["broken"].drops == {cause: 11}
    assert not statuses["broken"].messages
    assert not statuses["good"].drops
    each_twice = {"3d": 2, "6d": 2, "analog": 2, "force": 2, "event": 2}
    assert statuses["good"].messages == each_twice | {"status": 1}
    assert len(good.messages) == 11


def test_a_message_refused_still_counts_so_that_the_gap_shows() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    for output.error in (None, OutputError("no router", cause="no router"), None):
        fan_out.publish(FULL, STAMP, {ComponentType.MARKERS})
    assert [decode(message).sequence for _, message in output.messages] == [0, 2]


def test_a_failing_output_is_told_once_loudly_then_quietly_and_when_it_is_over(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.fanout")
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    lost = OutputError("no Zenoh router is connected: start zenohd", cause="no router")
    for output.error in (None, lost, lost, lost, None, None):
        fan_out.publish(FULL, STAMP, {ComponentType.MARKERS})
    warning, *repeats, recovery = caplog.records
    assert (warning.levelno, warning.getMessage()) == (logging.WARNING, f"lab to toy: {lost}")
    assert [record.levelno for record in repeats] == [logging.DEBUG, logging.DEBUG]
    assert recovery.levelno == logging.INFO
    assert "lab to toy: messages go out" in recovery.getMessage()


# Topics per tool -----------------------------------------------------------------------------


def publish_tools(fan_out: FanOut, count: int) -> None:
    fan_out.publish(tools_frame(*[IN_VIEW] * count), STAMP, ALL)


def test_tools_have_topics_where_switched_on_only() -> None:
    with_tools, without = ToyOutput("with", "Probe"), ToyOutput("without", "Probe")
    fan_out = FanOut("lab", [with_tools, without], ["with"])
    fan_out.set_parameters(parameters("Probe"))
    publish_tools(fan_out, 1)
    [(topic, _)] = [each for each in with_tools.messages if len(each[0].parts) == 2]
    assert topic == Topic("lab", ("6d", "Probe"), "rtc3d.tool_pose_t")
    assert without.tool_names() == []


def test_a_pose_is_published_while_somebody_listens() -> None:
    output = ToyOutput("toy", "Probe")
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters("Probe", "Head"))
    publish_tools(fan_out, 2)
    assert (len(output.poses("Probe")), len(output.poses("Head"))) == (1, 0)
    output.listened = {"Head"}
    publish_tools(fan_out, 2)
    assert (len(output.poses("Probe")), len(output.poses("Head"))) == (1, 1)
    output.listened = set()
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
def test_topics_carry_the_tools_labels(labels: list[str], names: list[str]) -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters(*labels))
    publish_tools(fan_out, len(names))
    assert output.tool_names() == names


def test_without_parameters_tools_are_numbered() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(Parameters())
    publish_tools(fan_out, 2)
    assert output.tool_names() == ["tool 1", "tool 2"]


def test_other_tools_replace_the_topics() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters("Probe", "Head"))
    publish_tools(fan_out, 2)
    fan_out.set_parameters(parameters("Head", "Foot", "Hand"))
    publish_tools(fan_out, 3)
    assert output.tool_names() == ["Head", "Foot", "Hand"]


def test_the_same_tools_again_keep_their_topics() -> None:
    output = ToyOutput("toy", "Probe")
    fan_out = FanOut("lab", [output], ["toy"])
    for session in (1, 2):
        fan_out.set_parameters(parameters("Probe"))
        fan_out.publish(tools_frame(IN_VIEW), STAMP._replace(session=session), ALL)
    counted = [(pose.sequence, pose.session) for pose in output.poses("Probe")]
    assert counted == [(0, 1), (1, 2)]
    assert output.given_up == []


def test_a_tool_that_stays_among_others_goes_on_counting() -> None:
    output = ToyOutput("toy", "Probe", "Head")
    fan_out = FanOut("lab", [output], ["toy"])
    for labels in (["Probe"], ["Head", "Probe"], ["Head", "Probe"]):
        fan_out.set_parameters(parameters(*labels))
        publish_tools(fan_out, len(labels))
    assert [pose.sequence for pose in output.poses("Probe")] == [0, 1, 2]
    assert [pose.sequence for pose in output.poses("Head")] == [0, 1]


def test_a_count_that_goes_up_and_down_declares_no_topic_twice() -> None:
    output = ToyOutput("toy", "A", "B", "C")
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters("A", "B", "C"))
    publish_tools(fan_out, 3)
    for count in (1, 0, 3, 2):
        publish_tools(fan_out, count)
    assert (output.tool_names(), output.given_up) == (["A", "B", "C"], [])
    counted = {name: [pose.sequence for pose in output.poses(name)] for name in "ABC"}
    assert counted == {"A": [0, 1, 2, 3], "B": [0, 1, 2], "C": [0, 1]}


def test_more_tools_than_any_lab_has_get_no_topics_and_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    output = ToyOutput("toy", "tool 1")
    fan_out = FanOut("lab", [output], ["toy"])
    for _ in range(2):
        publish_tools(fan_out, 257)
    assert output.tool_names() == []
    assert fan_out.outputs[0][1].drops == {"too many tools": 2}
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert fan_out.outputs[0][1].messages == {"6d": 2}
    publish_tools(fan_out, 256)
    assert len(output.tool_names()) == 256


@pytest.mark.parametrize(
    ("unit", "position_m"), [("mm", (0.1, 0.2, 0.3)), ("m", (100.0, 200.0, 300.0)), ("", (0.1, 0.2, 0.3))]
)
def test_poses_are_metres_whatever_the_servers_unit(unit: str, position_m: tuple[float, ...]) -> None:
    output = ToyOutput("toy", "Probe")
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters("Probe", unit=unit))
    publish_tools(fan_out, 1)
    assert output.poses("Probe")[0].position_m == pytest.approx(position_m)


def test_an_unknown_unit_is_told_and_taken_for_mm(caplog: pytest.LogCaptureFixture) -> None:
    output = ToyOutput("toy", "Probe")
    fan_out = FanOut("lab", [output], ["toy"])
    fan_out.set_parameters(parameters("Probe", unit="furlong"))
    publish_tools(fan_out, 1)
    assert output.poses("Probe")[0].position_m == pytest.approx((0.1, 0.2, 0.3))
    assert ["furlong" in record.getMessage() for record in caplog.records] == [True]


def test_an_unknown_unit_is_nobodys_affair_without_topics_per_tool(caplog: pytest.LogCaptureFixture) -> None:
    FanOut("lab", [ToyOutput()]).set_parameters(parameters("Probe", unit="furlong"))
    assert not caplog.records


# Pacing, layouts and listeners ---------------------------------------------------------------


def test_a_paced_component_is_numbered_by_itself_on_each_output() -> None:
    paced, whole = ToyOutput("paced"), ToyOutput("whole")
    paced.max_rate_hz = {ComponentType.MARKERS: 50.0}
    fan_out = FanOut("lab", [paced, whole])
    for number in range(20):  # 100 Hz
        frame = markers_frame(number, timestamp_us=10_000 * number, num_markers=1)
        fan_out.publish(frame, STAMP, ALL)
    for output, count in ((paced, 10), (whole, 20)):
        sequences = [decode(message).sequence for _, message in output.messages]
        assert sequences == list(range(count))


def test_events_are_never_left_out_whatever_the_limit() -> None:
    output = ToyOutput()
    output.max_rate_hz = {ComponentType.EVENT: 0.001}
    fan_out = FanOut("lab", [output])
    for _ in range(3):
        fan_out.publish(FULL, STAMP, {ComponentType.EVENT})
    assert [decode(message).sequence for _, message in output.messages] == [0, 1, 2]


def test_a_changed_number_of_markers_is_told_once() -> None:
    changes: list[int] = []
    fan_out = FanOut("lab", [], on_layout=lambda: changes.append(1))
    for num_markers, expected in ((2, 0), (2, 0), (3, 1), (3, 1), (2, 2)):
        fan_out.publish(markers_frame(1, timestamp_us=0, num_markers=num_markers), STAMP, ALL)
        assert len(changes) == expected


def test_somebody_listens_if_one_output_has_a_listener_to_one_component() -> None:
    deaf, heard = ToyOutput("deaf"), ToyOutput("heard", "6d")
    assert not FanOut("lab", [deaf]).listened(ALL)
    assert FanOut("lab", [deaf, heard]).listened({ComponentType.MARKERS, ComponentType.TOOLS})
    assert not FanOut("lab", [deaf, heard]).listened({ComponentType.MARKERS})


def test_every_output_shows_whether_frames_flow() -> None:
    outputs = [ToyOutput("a"), ToyOutput("b")]
    fan_out = FanOut("lab", outputs)
    fan_out.show_flowing(True)
    fan_out.show_flowing(False)
    assert [output.flowing for output in outputs] == [[True, False], [True, False]]


def markers_frame(number: int, *, timestamp_us: int, num_markers: int) -> Frame:
    items = np.zeros(num_markers, ITEM_DTYPES[ComponentType.MARKERS])
    component = build_component(ComponentType.MARKERS, number, timestamp_us, items)
    return split_frame(build_frame([component]), "big")
