import logging
from collections import Counter

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.messages.decode import decode
from gateway.messages.encode import encode_message
from gateway.messages.stamp import Stamp
from gateway.messages.topics import Topic
from gateway.outputs.memory import MemoryOutput
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ComponentType, encode_component
from gateway.rtc3d.frames import Frame, encode_frame, split_frame
from tests.losses import amounts
from tests.toy_output import ToyOutput
from tests.vectors import EMPTY_FRAME, FULL_FRAME

STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
ALL = frozenset(WIRE_ORDER)
MARKERS = frozenset({ComponentType.MARKERS})
FULL = split_frame(FULL_FRAME["big"], "big")


@pytest.fixture
def memory() -> MemoryOutput:
    output = MemoryOutput()
    output.start()
    return output


# Components ----------------------------------------------------------------------------------


def test_every_component_goes_to_every_output_under_its_topic() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    FanOut("lab", outputs).publish(FULL, STAMP, ALL)
    names = {1: "markers_t", 2: "analog_t", 3: "forces_t", 4: "tools_t", 5: "events_t"}
    expected = [
        (
            Topic("lab", (component.type.key,), f"rtc3d.{names[component.type]}"),
            encode_message(component, STAMP, 0),
        )
        for component in FULL.components
    ]
    assert len(expected) == 5
    assert [output.messages for output in outputs] == [expected, expected]


def test_all_topics_are_declared_before_the_first_frame() -> None:
    output = ToyOutput()
    FanOut("lab", [output])
    assert {topic.path for topic in output.declared} == {
        ("3d",), ("6d",), ("analog",), ("force",), ("event",), ("status",), ("clock",),
    }  # fmt: skip
    assert {topic.source for topic in output.declared} == {"lab"}


def test_the_source_is_announced_on_every_output() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    FanOut("lab", outputs)
    assert [output.announced for output in outputs] == [["lab"], ["lab"]]


def test_each_component_has_its_own_numbers_across_sessions(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, MARKERS)
    fan_out.publish(FULL, Stamp(STAMP.utime, STAMP.capture_utime, 2, 1), ALL)
    messages = [(topic.path, decode(message)) for topic, message in memory.messages]
    counted = {
        key: [(message.sequence, message.session) for path, message in messages if path == (key,)]
        for key in ("3d", "analog")
    }
    assert counted == {"3d": [(0, 1), (1, 1), (2, 2)], "analog": [(0, 1), (1, 2)]}


def test_components_that_are_not_wanted_are_not_published(memory: MemoryOutput) -> None:
    FanOut("lab", [memory]).publish(FULL, STAMP, frozenset({ComponentType.TOOLS, ComponentType.EVENT}))
    assert [topic.path for topic, _ in memory.messages] == [("6d",), ("event",)]


def test_an_empty_frame_publishes_nothing(memory: MemoryOutput) -> None:
    FanOut("lab", [memory]).publish(split_frame(EMPTY_FRAME["big"], "big"), STAMP, ALL)
    assert not memory.messages


def test_the_newest_message_of_each_component_can_be_read(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, MARKERS)
    newest = [decode(fan_out.newest(kind, "memory") or b"").sequence for kind in WIRE_ORDER]
    assert newest == [1 if kind is ComponentType.MARKERS else 0 for kind in WIRE_ORDER]


def test_status_and_clock_messages_have_their_own_topics(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish_status(b"status")
    fan_out.publish_clock(b"clock")
    assert list(memory.messages)[-2:] == [
        (Topic("lab", ("status",), "rtc3d.status_t"), b"status"),
        (Topic("lab", ("clock",), "rtc3d.clock_t"), b"clock"),
    ]


def test_frames_messages_and_bytes_are_counted_by_component(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    fan_out.publish(FULL, STAMP, ALL)
    fan_out.publish(FULL, STAMP, MARKERS)
    assert fan_out.frames == dict.fromkeys(WIRE_ORDER, 1) | {ComponentType.MARKERS: 2}
    [(_, status)] = fan_out.outputs
    sizes: Counter[str] = Counter()
    for topic, message in memory.messages:
        sizes[topic.path[0]] += len(message)
    assert status.message_bytes == sizes
    assert min(sizes.values()) > 0


# Failing outputs -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "cause"),
    [(OutputError("no router", cause="no router"), "no router"), (ValueError("a defect"), "ValueError")],
)
def test_an_output_that_raises_is_counted_and_does_not_stop_others(error: Exception, cause: str) -> None:
    broken, good = ToyOutput("broken"), ToyOutput("good")
    broken.error = error
    fan_out = FanOut("lab", [broken, good])
    for utime in (1, 2):
        fan_out.publish(FULL, Stamp(utime, utime, 1, 1), ALL)
    fan_out.publish_status(b"status")
    statuses = {output.name: status for output, status in fan_out.outputs}
    assert amounts(statuses["broken"].losses) == {cause: (11, 2)}
    assert not statuses["broken"].messages
    assert not statuses["good"].losses
    each_twice = {"3d": 2, "6d": 2, "analog": 2, "force": 2, "event": 2}
    assert statuses["good"].messages == each_twice | {"status": 1}
    assert len(good.messages) == 11


def test_a_refused_message_uses_up_its_sequence_number() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    for output.error in (None, OutputError("no router", cause="no router"), None):
        fan_out.publish(FULL, STAMP, MARKERS)
    assert [decode(message).sequence for _, message in output.messages] == [0, 2]


def test_an_output_failure_is_logged_once_and_its_end_with_the_total(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.publish.routes")
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    lost = OutputError("no Zenoh router is connected: start zenohd", cause="no router")
    for output.error in (None, lost, None):
        fan_out.publish(FULL, STAMP, ALL)
    fan_out.check_losses()
    fan_out.close()
    start, end = caplog.records
    assert (start.levelno, start.getMessage()) == (logging.WARNING, f"lab to toy: {lost}")
    assert (end.levelno, end.getMessage()) == (
        logging.INFO,
        "lab to toy: lost within 0.0 s: 5 messages of 1 frame (no router)",
    )


def test_messages_that_fail_now_and_then_are_one_failure(caplog: pytest.LogCaptureFixture) -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    for output.error in [OutputError("too large", cause="send failed"), None] * 5:
        fan_out.publish(FULL, STAMP, MARKERS)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert fan_out.outputs[0][1].messages == {"3d": 5}


# Pacing, layouts and subscribers -------------------------------------------------------------


def test_a_paced_component_has_consecutive_numbers_on_each_output() -> None:
    paced, whole = ToyOutput("paced"), ToyOutput("whole")
    paced.max_rate_hz = {ComponentType.MARKERS: 50.0}
    fan_out = FanOut("lab", [paced, whole])
    for number in range(20):  # 100 Hz
        frame = markers_frame(number, timestamp_us=10_000 * number, num_markers=1)
        fan_out.publish(frame, STAMP, ALL)
    for output, count in ((paced, 10), (whole, 20)):
        sequences = [decode(message).sequence for _, message in output.messages]
        assert sequences == list(range(count))


def test_events_are_never_paced() -> None:
    output = ToyOutput()
    output.max_rate_hz = {ComponentType.EVENT: 0.001}
    fan_out = FanOut("lab", [output])
    for _ in range(3):
        fan_out.publish(FULL, STAMP, frozenset({ComponentType.EVENT}))
    assert [decode(message).sequence for _, message in output.messages] == [0, 1, 2]


def test_a_changed_number_of_markers_is_reported_once() -> None:
    changes: list[int] = []
    fan_out = FanOut("lab", [], on_items_changed=lambda: changes.append(1))
    for num_markers, expected in ((2, 0), (2, 0), (3, 1), (3, 1), (2, 2)):
        fan_out.publish(markers_frame(1, timestamp_us=0, num_markers=num_markers), STAMP, ALL)
        assert len(changes) == expected


def test_a_changed_number_of_markers_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.item_counts")
    fan_out = FanOut("lab", [])
    for num_markers in (2, 3):
        fan_out.publish(markers_frame(1, timestamp_us=0, num_markers=num_markers), STAMP, ALL)
    assert caplog.messages == ["lab: number of items in 3d changed from 2 to 3"]


def test_frames_of_alternating_streams_are_not_a_change() -> None:
    changes: list[int] = []
    fan_out = FanOut("lab", [], on_items_changed=lambda: changes.append(1))
    for _ in range(3):
        fan_out.publish(markers_frame(1, timestamp_us=0, num_markers=2), STAMP, MARKERS)
        fan_out.publish(FULL, STAMP, ALL - MARKERS)
    assert not changes


def test_a_changed_number_of_events_is_not_reported() -> None:
    changes: list[int] = []
    fan_out = FanOut("lab", [], on_items_changed=lambda: changes.append(1))
    for num_events in range(3):
        fan_out.publish(events_frame(num_events), STAMP, ALL)
    assert not changes


def test_the_number_of_remembered_layouts_is_bounded(memory: MemoryOutput) -> None:
    fan_out = FanOut("lab", [memory])
    for num_events in range(300):
        fan_out.publish(events_frame(num_events), STAMP, ALL)
    assert fan_out._plan_for.cache_info().currsize == 64
    assert len(memory.messages) == 300
    fan_out.forget_layouts()
    assert fan_out._plan_for.cache_info().currsize == 0


def test_a_component_has_subscribers_if_one_output_has_one() -> None:
    without, with_tools = ToyOutput("without"), ToyOutput("with tools", "6d")
    assert not FanOut("lab", [without]).has_subscribers(ALL)
    assert FanOut("lab", [without, with_tools]).has_subscribers({ComponentType.MARKERS, ComponentType.TOOLS})
    assert not FanOut("lab", [without, with_tools]).has_subscribers({ComponentType.MARKERS})


def test_every_output_shows_whether_frames_arrive() -> None:
    outputs = [ToyOutput("a"), ToyOutput("b")]
    fan_out = FanOut("lab", outputs)
    fan_out.show_streaming(True)
    fan_out.show_streaming(False)
    assert [output.streaming for output in outputs] == [[True, False], [True, False]]


def markers_frame(number: int, *, timestamp_us: int, num_markers: int) -> Frame:
    items = np.zeros(num_markers, ITEM_DTYPES[ComponentType.MARKERS])
    component = encode_component(ComponentType.MARKERS, number, timestamp_us, items)
    return split_frame(encode_frame([component]), "big")


def events_frame(num_events: int) -> Frame:
    items = np.zeros(num_events, ITEM_DTYPES[ComponentType.EVENT])
    return split_frame(encode_frame([encode_component(ComponentType.EVENT, 1, 0, items)]), "big")
