"""What a fan-out publishes on each output, counts and logs, and what happens when outputs change."""

import logging
from collections import Counter
from types import SimpleNamespace

import pytest

from gateway.errors import OutputError
from gateway.messages.decode import decode
from gateway.messages.encode import Stamp, encode_message
from gateway.messages.topics import Topic
from gateway.publish.fan_out import FanOut, ItemCounts
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from gateway.runtime.losses import counts_text
from tests.support.clocks import Clock
from tests.support.errors import names
from tests.support.memory_output import MemoryOutput
from tests.support.parameters import in_metres
from tests.support.statuses import amounts
from tests.support.toy_output import ToyOutput
from tests.support.vectors import EMPTY_FRAME
from tests.unit.publish.rig import (
    ALL,
    EVENT,
    FULL,
    MARKERS,
    NO_ROUTER,
    ONLY_MARKERS,
    STAMP,
    TOOLS,
    frame,
    publish_full,
    sequences,
)

PROBES = in_metres(
    Parameters(tools=Parameters6D(tools=(Tool(id="0", label="Probe"), Tool(id="1", label="H"))))
)


# Components ----------------------------------------------------------------------------------


def test_every_component_goes_to_every_output_under_its_topic() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    publish_full(FanOut("lab", outputs))
    names = {1: "markers_t", 2: "analog_t", 3: "forces_t", 4: "tools_t", 5: "events_t"}
    expected = [
        (Topic("lab", (each.type.key,), f"rtc3d.{names[each.type]}"), encode_message(each, STAMP, 0))
        for each in FULL.components
    ]
    assert len(expected) == 5
    assert [output.messages for output in outputs] == [expected, expected]


def test_all_topics_are_declared_and_the_source_is_announced_before_the_first_frame() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    FanOut("lab", outputs)
    paths = {("3d",), ("6d",), ("analog",), ("force",), ("event",), ("status",), ("clock",)}
    for output in outputs:
        assert output.announced == ["lab"]
        assert {(topic.source, topic.path) for topic in output.declared} == {("lab", path) for path in paths}


def test_only_wanted_components_that_a_frame_has_are_published() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    publish_full(fan_out, {TOOLS, EVENT})
    fan_out.publish(split_frame(EMPTY_FRAME["big"], "big"), STAMP, ALL)
    assert [topic.path for topic, _ in output.messages] == [("6d",), ("event",)]


def test_the_newest_message_of_each_component_can_be_read() -> None:
    fan_out = FanOut("lab", [ToyOutput()])
    publish_full(fan_out)
    publish_full(fan_out, ONLY_MARKERS)
    newest = [decode(fan_out.newest(kind, "toy") or b"").sequence for kind in WIRE_ORDER]
    assert newest == [1 if kind is MARKERS else 0 for kind in WIRE_ORDER]


def test_frames_messages_and_bytes_are_counted_by_topic() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    publish_full(fan_out)
    publish_full(fan_out, ONLY_MARKERS)
    fan_out.publish_status(b"status")
    fan_out.publish_clock(b"clock")
    assert output.messages[-2:] == [
        (Topic("lab", ("status",), "rtc3d.status_t"), b"status"),
        (Topic("lab", ("clock",), "rtc3d.clock_t"), b"clock"),
    ]
    assert fan_out.frames == dict.fromkeys(WIRE_ORDER, 1) | {MARKERS: 2}
    [(_, status)] = fan_out.outputs
    sizes: Counter[str] = Counter()
    for topic, message in output.messages:
        sizes[topic.path[0]] += len(message)
    assert status.message_bytes == sizes
    assert status.messages == Counter(topic.path[0] for topic, _ in output.messages)


# Outputs that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "cause", "text"),
    [
        (NO_ROUTER, "no router", str(NO_ROUTER)),
        (ValueError("a defect"), "ValueError", "ValueError: a defect"),
    ],
)
def test_an_output_that_raises_is_counted_logged_and_does_not_stop_others(
    error: Exception, cause: str, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    broken, good = ToyOutput("broken"), ToyOutput("good")
    broken.error = error
    fan_out = FanOut("lab", [broken, good])
    for utime in (1, 2):
        fan_out.publish(FULL, Stamp(utime, utime, 1, 1), ALL)
    fan_out.publish_status(b"status")
    [(_, of_broken), (_, of_good)] = fan_out.outputs
    assert (amounts(of_broken.losses), of_broken.messages) == ({cause: (11, 2)}, {})
    each_twice = {"3d": 2, "6d": 2, "analog": 2, "force": 2, "event": 2}
    assert (of_good.losses, of_good.messages) == ([], each_twice | {"status": 1})
    assert len(good.messages) == 11
    assert caplog.messages == [f"lab to broken: {text}"]


def test_an_output_failure_is_logged_once_and_its_end_with_the_total(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "gateway.publish.routes")
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    for output.error in (None, NO_ROUTER, None):
        publish_full(fan_out)
    fan_out.maintain()
    fan_out.close()
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    began, ended = caplog.messages
    assert began == f"lab to toy: {NO_ROUTER}"
    assert names(ended, "lab to toy", counts_text([("no router", 5, 1)]))


@pytest.mark.interpreted
def test_an_output_that_has_just_been_added_may_take_a_moment_to_open(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "gateway.publish.routes")
    clock = Clock(100.0)
    monkeypatch.setattr("gateway.publish.routes.time", SimpleNamespace(monotonic=clock))
    output = ToyOutput("lcm")
    output.error = OutputError("LCM is not open", cause="not open")
    fan_out = FanOut("lab", [output])
    for clock.now_s in (101.9, 101.9, 102.1, 102.2):
        fan_out.publish_status(b"status")
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING"]


# Pacing, numbers of items, layouts and subscribers -------------------------------------------


@pytest.mark.parametrize(
    ("period_us", "arrival_period_us", "has_clock", "expected"),
    [
        pytest.param(10_000, 0, True, [0, 2, 4], id="by the server's clock"),
        pytest.param(20_000, 10_000, True, [0, 1, 2, 3, 4, 5], id="not by the arrivals"),
        pytest.param(20_000, 10_000, False, [0, 2, 4], id="without a clock by the arrivals"),
    ],
)
def test_a_paced_component_is_published_at_its_rate(
    period_us: int, arrival_period_us: int, has_clock: bool, expected: list[int]
) -> None:
    output = ToyOutput()
    output.max_rate_hz = {MARKERS: 50.0}
    fan_out = FanOut("lab", [output])
    for number in range(6):
        utime = arrival_period_us * number
        stamp = Stamp(utime=utime, capture_utime=utime, session=1, parameters_version=1, has_clock=has_clock)
        fan_out.publish(frame(number, MARKERS, timestamp_us=period_us * number), stamp, ONLY_MARKERS)
    assert [decode(message).frame_number for _, message in output.messages] == expected


def test_events_are_never_paced() -> None:
    output = ToyOutput()
    output.max_rate_hz = {EVENT: 0.001}
    fan_out = FanOut("lab", [output])
    for _ in range(3):
        publish_full(fan_out, {EVENT})
    assert sequences(output, "event") == [0, 1, 2]


@pytest.mark.parametrize(
    ("component", "num_items", "expected"),
    [(MARKERS, (2, 2, 3, 3, 2), [0, 0, 1, 1, 2]), (EVENT, (0, 1, 2), [0, 0, 0])],
)
def test_a_changed_number_of_items_is_reported_once_and_of_events_never(
    component: ComponentType, num_items: tuple[int, ...], expected: list[int]
) -> None:
    changes: list[int] = []
    reported = []
    fan_out = FanOut("lab", [], on_items_changed=lambda: changes.append(1))
    for number in num_items:
        fan_out.publish(frame(1, component, num_items=number), STAMP, ALL)
        # The frame of another stream between them is no change.
        fan_out.publish(FULL, STAMP, frozenset({ComponentType.ANALOG}))
        reported.append(len(changes))
    assert reported == expected


def test_numbers_of_items_are_compared_within_a_session() -> None:
    counts = ItemCounts("lab")
    updates: list[tuple[dict[ComponentType, int], int]] = [
        ({MARKERS: 2}, 1), ({MARKERS: 3}, 1), ({MARKERS: 4}, 2), ({TOOLS: 1}, 2), ({MARKERS: 4, TOOLS: 2}, 2),
        ({MARKERS: 5, TOOLS: 2}, 2), ({MARKERS: 5}, 3), ({MARKERS: 6, TOOLS: 3}, 3),
    ]  # fmt: skip
    assert [counts.update(*each) for each in updates] == [False, True, False, False, True, True, False, True]


def test_a_server_that_changes_its_number_all_the_time_does_not_fill_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    clock = Clock()
    counts = ItemCounts("lab", clock)
    for number in range(1001):
        counts.update({MARKERS: number % 2, TOOLS: 1}, 1)
    changed = "lab: number of items in 3d changed from"
    assert caplog.messages == [f"{changed} 0 to 1"]
    counts.check()
    clock.now_s += 30
    counts.check()
    counts.check()
    assert caplog.messages[1:] == [f"{changed} 1 to 0, after 999 changes"]
    clock.now_s += 30
    counts.update({MARKERS: 7}, 1)
    assert caplog.messages[2:] == [f"{changed} 0 to 7"]


def test_the_number_of_remembered_layouts_is_bounded() -> None:
    memory = MemoryOutput()
    memory.start()
    fan_out = FanOut("lab", [memory])
    for num_items in range(300):
        fan_out.publish(frame(1, EVENT, num_items=num_items), STAMP, ALL)
    assert (fan_out._plan_for.cache_info().currsize, len(memory.messages)) == (64, 300)
    fan_out.forget_layouts()
    assert fan_out._plan_for.cache_info().currsize == 0


def test_a_component_has_subscribers_if_one_output_has_one() -> None:
    without, with_tools = ToyOutput("without"), ToyOutput("with tools", "6d")
    assert not FanOut("lab", [without]).has_subscribers(ALL)
    assert FanOut("lab", [without, with_tools]).has_subscribers({MARKERS, TOOLS})
    assert not FanOut("lab", [without, with_tools]).has_subscribers({MARKERS})


# Outputs that are replaced -------------------------------------------------------------------


@pytest.mark.parametrize("is_removed_first", [False, True])
def test_a_replacement_continues_numbers_and_counters(is_removed_first: bool) -> None:
    before, after = ToyOutput("side"), ToyOutput("side")
    fan_out = FanOut("lab", [before])
    publish_full(fan_out)
    if is_removed_first:
        fan_out.set_outputs([])
    fan_out.set_outputs([after])
    publish_full(fan_out)
    assert (sequences(before, "3d"), sequences(after, "3d")) == ([0], [1])
    if not is_removed_first:
        [(output, status)] = fan_out.outputs
        sent = [message for topic, message in (*before.messages, *after.messages) if topic.path == ("3d",)]
        assert (output, status.messages["3d"]) == (after, 2)
        assert status.message_bytes["3d"] == sum(map(len, sent))


def test_a_replacement_continues_the_counts_of_what_was_lost() -> None:
    before, after = ToyOutput("side"), ToyOutput("side")
    before.error = after.error = NO_ROUTER
    fan_out = FanOut("lab", [before])
    fan_out.publish_status(b"status")
    fan_out.set_outputs([after])
    fan_out.publish_status(b"status")
    assert amounts(fan_out.outputs[0][1].losses) == {"no router": (2, 0)}


def test_removing_an_output_closes_everything_declared_on_it() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    declared = list(output.declared)
    fan_out.set_outputs([])
    publish_full(fan_out)
    assert (output.declared, output.announced, output.messages) == ([], [], [])
    assert sorted(output.closed_topics) == sorted(declared)


def test_every_output_shows_whether_frames_arrive_until_the_fan_out_is_closed() -> None:
    one, new = ToyOutput("one", "Probe", has_tool_poses=True), ToyOutput("two")
    fan_out = FanOut("lab", [one])
    fan_out.set_parameters(PROBES)
    fan_out.show_streaming(True)
    fan_out.set_outputs([one, new])
    publish_full(fan_out)
    assert (new.announced, one.streaming, new.streaming) == (["lab"], [True], [True])
    fan_out.show_streaming(False)
    fan_out.show_streaming(True)
    fan_out.close()
    for output in (one, new):
        assert (output.declared, output.announced, output.streaming) == ([], [], [True, False] * 2)


@pytest.mark.parametrize("runs", [True, False])
def test_every_output_shows_once_whether_a_measurement_runs(
    monkeypatch: pytest.MonkeyPatch, *, runs: bool
) -> None:
    shown: list[tuple[str, bool | None]] = []
    monkeypatch.setattr(ToyOutput, "show_measurement", lambda self, _, runs: shown.append((self.name, runs)))
    one, new = ToyOutput("one"), ToyOutput("new")
    fan_out = FanOut("lab", [one])
    for is_running in (runs, runs):
        fan_out.show_measurement(is_running)
    fan_out.set_outputs([one, new])
    fan_out.show_measurement(None)
    assert shown == [("one", runs), ("new", runs), ("one", None), ("new", None)]


def test_tool_topics_stay_open_on_an_output_that_stays() -> None:
    outputs = [ToyOutput(name, "Probe", has_tool_poses=True) for name in ("stays", "side", "side")]
    stays, before, after = outputs
    fan_out = FanOut("lab", [stays, before])
    fan_out.set_parameters(PROBES)
    publish_full(fan_out)
    fan_out.set_outputs([stays, after])
    publish_full(fan_out)
    assert stays.closed_topics == []
    assert [sequences(output, "6d", "Probe") for output in outputs] == [[0, 1], [0], [1]]
    assert before.tool_names() == []


def test_tool_topics_are_closed_where_they_are_switched_off() -> None:
    output = ToyOutput("toy", "Probe", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    fan_out.set_parameters(PROBES)
    publish_full(fan_out)
    output.has_tool_poses = False
    fan_out.set_outputs([output])
    publish_full(fan_out)
    assert (output.tool_names(), len(output.poses("Probe")), sequences(output, "3d")) == ([], 1, [0, 1])
