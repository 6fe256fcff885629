"""Live frames: the same as in a take of the same messages, and nothing left out without being counted."""

import asyncio
import math
import time
from collections.abc import Iterable, Iterator
from typing import Any, Self

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.client import live_frames, live_join, queued_reception
from gateway.client.client import GatewayAddress
from gateway.client.history_requests import COMPLETE, HistoryAnswer, HistoryRequest
from gateway.client.live_frames import ClockDifference, Frame, Sent
from gateway.client.live_join import MAX_WAIT_S
from gateway.client.live_stream import _MAX_WAIT_S, DESCRIBED_WITHIN_S, Live, live
from gateway.errors import SelectionError
from gateway.messages.history import sequence_of
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.takes.files.series import Series
from gateway.takes.files.take import open_take
from tests.support.errors import raises
from tests.support.takes import START_UTIME, Message, frame, parameters, write_take

MARKERS, ANALOG, TOOLS = ComponentType.MARKERS, ComponentType.ANALOG, ComponentType.TOOLS
COLUMNS = ("utime", "capture_utime", "sequence", "session", "parameters_version", "frame_number")


def xml(*labels: str) -> bytes:
    names = "".join(f"<Marker><Label><![CDATA[{label}]]></Label></Marker>" for label in labels)
    content = f"<The_3D><Markers>{len(labels)}</Markers><Frequency>100</Frequency>{names}</The_3D>"
    return f"<Parameters>{content}</Parameters>".encode()


class Fed(Live):
    """Live data that get their messages from a test."""

    def __init__(self, *sources: str, **options: Any) -> None:
        super().__init__(GatewayAddress(), sources, **options)
        self._reception.is_queueing = True

    def open(self) -> Self:
        return self

    def feed(self, messages: Iterable[Message]) -> None:
        reception = self._reception
        for channel, message in messages:
            _, name, key = channel.lower().split("_")
            source = reception.source(name, f"MOCAP_{name.upper()}", is_known=True)
            assert source is not None
            series = reception.series(source, key, channel)
            assert series is not None
            if key == "parameters":
                reception.receive_parameters(series, message, is_made=False)
            else:
                reception.receive(series, message)

    def frames(self, count: int) -> list[Frame]:
        found = iter(self)
        return [next(found) for _ in range(count)]


def ones(component: ComponentType, sequence: int, num_items: int = 2, **options: Any) -> Message:
    num_fields = len(ITEM_DTYPES[component].names or ()) or 1
    item: Any = (float(sequence),) * num_fields if num_fields > 1 else float(sequence)
    return frame(component, [item] * num_items, sequence, **options)


@st.composite
def recordings(draw: st.DrawFn) -> list[Message]:
    """Messages of several components whose numbers of items, labels and versions change."""
    messages = [parameters(xml("a", "b"), 1)]
    numbers = dict.fromkeys((MARKERS, ANALOG, TOOLS, ComponentType.FORCE), 0)
    version = 1
    for _ in range(draw(st.integers(1, 30))):
        component = draw(st.sampled_from([*numbers]))
        if draw(st.integers(0, 9)) == 0:
            version += 1
            labels = draw(st.lists(st.sampled_from("abcd"), max_size=3))
            messages.append(parameters(xml(*labels), version))
        numbers[component] += draw(st.integers(1, 3))
        size = draw(st.integers(0, 3))
        nan = draw(st.booleans())
        num_fields = len(ITEM_DTYPES[component].names or ()) or 1
        value = math.nan if nan else draw(st.floats(width=32))
        item: Any = (value,) * num_fields if num_fields > 1 else value
        messages.append(frame(component, [item] * size, numbers[component], version=version))
    return messages


def same(live_series: Series, recorded: Series) -> None:
    for name in COLUMNS:
        assert getattr(live_series, name).tobytes() == getattr(recorded, name).tobytes()
    assert live_series.items.tobytes() == recorded.items.tobytes()
    assert live_series.labels == recorded.labels
    assert live_series.units == recorded.units
    assert live_series.seconds.tolist() == recorded.seconds.tolist()


@given(recordings())
def test_what_is_collected_is_what_a_take_of_the_same_messages_has(
    tmp_path_factory: pytest.TempPathFactory, messages: list[Message]
) -> None:
    """An analysis that was written for a take runs on live data without a change."""
    data = Fed()
    data.feed(messages)
    collected = data.collect()
    path = write_take(tmp_path_factory.mktemp("take") / "a.lcmlog", messages)
    recorded = open_take(path)
    assert collected.path is None
    found, expected = collected.sources["lab"], recorded.sources["lab"]
    assert found.series.keys() == expected.series.keys()
    collected_start, take_start = collected.start_utime, recorded.start_utime
    assert collected_start >= take_start
    for key, series in expected.series.items():
        found.series[key].start_utime = series.start_utime
        same(found.series[key], series)


@given(recordings())
def test_each_frame_is_a_row_of_what_is_collected(messages: list[Message]) -> None:
    data, again = Fed(), Fed()
    data.feed(messages)
    again.feed(messages)
    series = again.collect().sources["lab"].series
    rows: dict[str, int] = {}
    for each in data.frames(sum("PARAMETERS" not in channel for channel, _ in messages)):
        row, place = each.row, rows.get(each.key, 0)
        rows[each.key] = place + 1
        whole = series[each.key]
        assert (each.sequence, each.capture_utime) == (whole.sequence[place], whole.capture_utime[place])
        columns = [whole.labels.index(label) for label in row.labels]
        assert row.items.tobytes() == whole.items[place, columns].tobytes()
        assert each.series[each.key].items.tobytes() == row.items.tobytes()
        assert each.parameters is not None


def test_items_are_found_by_their_labels_in_a_frame_and_in_a_series() -> None:
    data = Fed()
    data.feed([parameters(xml("head", "hand")), ones(MARKERS, 3), ones(TOOLS, 4), ones(ANALOG, 5)])
    markers, tools, analog = data.frames(3)
    assert markers.markers["hand"].tolist() == [3, 3, 3]
    assert markers.series["3d"]["hand"].tolist() == [[3, 3, 3]]
    assert tools.tools["tool 1"].tolist() == [4] * 7
    assert analog.analog["channel 2"] == 5
    assert markers.markers.unit == "mm"
    with pytest.raises(KeyError, match="head, hand"):
        markers.markers["foot"]
    with raises(AttributeError, "forces", "3d"):
        _ = markers.forces


def test_quaternions_have_both_orders() -> None:
    data = Fed()
    data.feed([parameters(xml()), frame(TOOLS, [(1, 2, 3, 4, 5, 6, 7, 0)])])
    [tools] = [each.tools for each in data.frames(1)]
    assert tools.quaternions.tolist() == [[1, 2, 3, 4]]
    assert tools.quaternions_xyzw.tolist() == [[2, 3, 4, 1]]
    assert tools.positions.tolist() == [[5, 6, 7]]


def test_gaps_and_sessions_are_those_of_the_messages() -> None:
    data = Fed()
    data.feed([parameters(xml()), ones(MARKERS, 4), ones(MARKERS, 5), ones(MARKERS, 9, session=2)])
    assert [(each.sequence, each.gap, each.session) for each in data.frames(3)] == [
        (4, 0, 1),
        (5, 0, 1),
        (9, 3, 2),
    ]


def test_a_message_that_cannot_be_decoded_is_a_gap() -> None:
    data = Fed()
    channel, message = ones(MARKERS, 1)
    data.feed([parameters(xml()), ones(MARKERS, 0), (channel, message[:-1]), ones(MARKERS, 2)])
    assert [(each.sequence, each.gap) for each in data.frames(2)] == [(0, 0), (2, 1)]
    channel, message = ones(MARKERS, 5)
    data.feed([(channel, message[:-1]), ones(MARKERS, 6)])
    assert [(each.sequence, each.gap) for each in data.frames(1)] == [(6, 3)]


def test_a_program_that_is_too_slow_loses_the_oldest_and_is_warned_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(queued_reception, "MAX_WAITING", 3)
    data = Fed()
    data.feed([parameters(xml()), *(ones(MARKERS, number) for number in range(10))])
    with pytest.warns(RuntimeWarning, match="7 messages were dropped") as warned:
        frames = data.frames(3)
    assert [(each.sequence, each.gap) for each in frames] == [(7, 7), (8, 0), (9, 0)]
    data.feed([ones(MARKERS, number) for number in range(10, 15)])
    assert [each.gap for each in data.frames(3)] == [2, 0, 0]
    assert len(warned) == 1
    assert data.num_dropped == 9


def test_a_complete_program_that_is_too_slow_gets_the_rest_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queued_reception, "MAX_WAITING", 8)
    history = [message for _, message in (ones(MARKERS, number) for number in range(30))]

    def answer(_series: object, request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        first = int(request.options["from"])
        last = min(int(request.options["to"]), first + 2)
        return HistoryAnswer(history[first : last + 1], first, last, len(history) - 1)

    data = Fed()
    data._reception.complete(answer, lambda *_: [], COMPLETE)
    data.feed([parameters(xml()), *(ones(MARKERS, number) for number in range(30))])
    assert [(each.sequence, each.gap) for each in data.frames(30)] == [(number, 0) for number in range(30)]
    assert data.num_dropped == 0


def test_the_newest_frame_needs_no_queue() -> None:
    data = Fed()
    data._reception.is_queueing = False
    assert data.latest() is None
    data.feed([parameters(xml("head"))] + [ones(MARKERS, number, 1) for number in range(5)])
    newest = data.latest("3d")
    assert newest is not None
    assert (newest.sequence, newest.markers.labels) == (4, ("head",))
    assert data.latest("6d") is None
    assert data.latest("3d", source="stage") is None
    assert not data._reception.take_waiting()


def test_the_newest_frame_is_that_of_the_newest_arrival_although_the_clock_was_set_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of several keys. Its age is right whether it is decoded before the clock was set or after."""
    data = Fed("lab")
    steady_us, wall_us = 0, START_UTIME
    monkeypatch.setattr(queued_reception, "now_steady_us", lambda: steady_us)
    monkeypatch.setattr(queued_reception, "now_utime", lambda: steady_us + wall_us)
    monkeypatch.setattr(live_frames, "now_steady_us", lambda: steady_us)
    monkeypatch.setattr(live_frames, "now_utime", lambda: steady_us + wall_us)
    data.feed([ones(TOOLS, 0, version=0, utime=START_UTIME)])
    kept = data.latest()
    steady_us, wall_us = 50_000, START_UTIME - 10_000_000
    data.feed([ones(MARKERS, 5, version=0, utime=START_UTIME + 50_000)])
    newest = data.latest()
    assert kept is not None
    assert newest is not None
    assert (kept.key, newest.key) == ("6d", "3d")
    assert kept.age_s == pytest.approx(0.052)
    assert newest.age_s == pytest.approx(0.002)
    assert newest.capture_time == pytest.approx((steady_us + wall_us) / 1e6 - newest.age_s)
    assert data.latest("6d", max_age_s=0.01) is None


def test_a_frame_waits_for_its_parameters() -> None:
    data = Fed()
    data.feed([ones(MARKERS, 0, version=1)])
    assert data._decode() is not None
    assert not data._ready
    data.feed([parameters(xml("head", "hand"))])
    [found] = data.frames(1)
    assert found.markers.labels == ("head", "hand")


def test_parameters_that_never_come_are_awaited_once() -> None:
    """Otherwise, the program would get the frames of each version two seconds late for ever."""
    data = Fed()
    data.feed([ones(MARKERS, 0, version=1)])
    now_s = time.monotonic()
    assert data._described(now_s) == ([], DESCRIBED_WITHIN_S)
    now_s += DESCRIBED_WITHIN_S
    for number in range(1, 4):
        [given], _ = data._described(now_s)
        assert sequence_of(given.message) == number - 1
        data.feed([ones(MARKERS, number, version=1)])


def test_what_is_collected_after_frames_that_waited_is_in_order() -> None:
    """Frames that wait for their parameters came before those that came meanwhile."""
    data = Fed()
    data.feed([ones(MARKERS, 0, version=1)])
    data._decode()
    data.feed([ones(MARKERS, 1, version=1)])
    assert data.collect().sources["lab"].series["3d"].sequence.tolist() == [0, 1]


def test_what_comes_from_the_history_says_nothing_about_the_clock_of_the_gateway(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It was sent long before it arrived; frames would seem to be seconds younger than they are."""
    monkeypatch.setattr(live_frames, "now_steady_us", lambda: 0)
    monkeypatch.setattr(live_frames, "now_utime", lambda: START_UTIME)
    data = Fed()
    data.feed([ones(MARKERS, 0, version=0, utime=START_UTIME - 10_000_000)])
    [arrival] = data._reception.take_waiting()
    [found] = live_frames.decode_frames([arrival._replace(is_past=True, steady_us=0)], START_UTIME)
    assert found.age_s == pytest.approx(10.0, abs=0.1)


def test_a_version_that_a_gateway_uses_again_means_the_parameters_of_its_time() -> None:
    data = Fed()
    data.feed([parameters(xml("old"), 1), parameters(xml("new"), 1, utime=START_UTIME + 1_000_000)])
    data.feed([ones(MARKERS, 0, 1), ones(MARKERS, 200, 1)])
    assert [each.markers.labels for each in data.frames(2)] == [("old",), ("new",)]


def test_parameters_that_come_later_with_a_version_known_by_then_count() -> None:
    data = Fed()
    data.feed([parameters(xml("old"), 1), ones(MARKERS, 0, 1)])
    assert data.frames(1)[0].markers.labels == ("old",)
    data.feed([parameters(xml("new"), 1, utime=START_UTIME + 1_000_000), ones(MARKERS, 200, 1)])
    assert data.frames(1)[0].markers.labels == ("new",)


def test_what_is_missing_in_any_of_the_joined_messages_is_the_gap() -> None:
    """Who looks at the gap of a frame wants to know whether it has everything since the one before."""
    messages = [ones(MARKERS, number, timestamp_us=number * 5000) for number in range(3)]
    messages += [ones(ANALOG, number, timestamp_us=number * 1000) for number in (0, 1, 2, 4, 5, 6, 9, 10)]
    data = Fed("lab", components=["3d", "analog"], join=True)
    data.feed([parameters(xml()), *messages])
    assert [each.gap for each in data.frames(3)] == [0, 1, 2]


def test_what_a_join_leaves_out_is_counted_and_the_program_is_warned(monkeypatch: pytest.MonkeyPatch) -> None:
    """As what a slow program loses: otherwise, the first component could be missing unsaid."""
    monkeypatch.setattr(live_join, "MAX_FRAMES", 10)
    data = Fed("lab", components=["3d", "analog"], join=True)
    data.feed([parameters(xml()), *(ones(ANALOG, number) for number in range(30))])
    with pytest.warns(RuntimeWarning, match="20 messages"):
        data._decode()
    assert data.num_dropped == 20


@pytest.mark.parametrize("ahead", [MARKERS, ANALOG])
def test_components_are_joined_by_the_time_stamps_whichever_comes_first(ahead: ComponentType) -> None:
    """5 analog samples belong to each frame of markers: those after the frame before, up to its own time."""
    messages = [ones(MARKERS, number, timestamp_us=number * 5000) for number in range(3)]
    messages += [ones(ANALOG, number, timestamp_us=number * 1000) for number in range(11)]
    messages.sort(key=lambda each: (each[0].endswith("3D")) != (ahead is MARKERS))
    data = Fed("lab", components=["3d", "analog"], join=True)
    data.feed([parameters(xml()), *messages])
    frames = data.frames(3)
    assert [each.series["analog"].sequence.tolist() for each in frames] == [
        [0],
        [1, 2, 3, 4, 5],
        [6, 7, 8, 9, 10],
    ]
    assert [(each.key, each.sequence, each.analog.sequence) for each in frames] == [
        ("3d", 0, 0),
        ("3d", 1, 5),
        ("3d", 2, 10),
    ]


def test_a_component_that_stops_is_awaited_once(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 100.0
    monkeypatch.setattr("gateway.client.live_stream.time.monotonic", lambda: now_s)
    data = Fed("lab", components=["3d", "analog"], join=True)
    data.feed([parameters(xml()), ones(MARKERS, 0), ones(MARKERS, 1)])
    wait_s = data._decode()
    assert wait_s == MAX_WAIT_S
    now_s += MAX_WAIT_S
    data._decode()
    assert [each.sequence for each in data._ready] == [0, 1]
    data.feed([ones(MARKERS, 2)])
    assert data._decode() == _MAX_WAIT_S
    assert [each.sequence for each in data._ready] == [0, 1, 2]


def test_two_sources_are_joined_by_their_times_of_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the gateway of stage is 3 s behind."""
    now_us = 0
    monkeypatch.setattr(queued_reception, "now_steady_us", lambda: now_us)
    data = Fed("lab", "stage", components=["3d"], join=True)
    data.feed([parameters(xml("a", "b")), parameters(xml("c"), source="stage")])
    for number in range(3):
        now_us = 100_000 * number
        utime, behind = START_UTIME + now_us, START_UTIME + now_us - 3_000_001
        data.feed([ones(MARKERS, number, utime=utime, timestamp_us=number)])
        data.feed([ones(MARKERS, 50 + number, 1, utime=behind, source="stage", timestamp_us=7 * number)])
    now_us = 10**6
    behind = START_UTIME + now_us - 3_000_001
    data.feed([ones(MARKERS, 60, 1, utime=behind, source="stage", timestamp_us=999)])
    frames = data.frames(3)
    assert [(each.source, each.sequence) for each in frames] == [("lab", 0), ("lab", 1), ("lab", 2)]
    assert [each.sources["stage"].sequence for each in frames] == [50, 51, 52]
    assert frames[0].sources["stage"].markers.labels == ("c",)


async def test_frames_can_be_awaited() -> None:
    data = Fed()
    data.feed([parameters(xml())])
    asyncio.get_running_loop().call_soon(data.feed, [ones(MARKERS, 0), ones(MARKERS, 1)])
    found = []
    async for each in data:
        found.append(each.sequence)
        if len(found) == 2:
            data.close()
    assert found == [0, 1]


def test_a_program_to_which_nothing_comes_does_not_wait_without_an_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Python does not see a Ctrl-C that comes just before it begins to wait."""
    data = Fed()
    waits: list[float | None] = []

    def wait(_num_seen: int, timeout_s: float | None) -> None:
        waits.append(timeout_s)
        data.close()

    monkeypatch.setattr(data._reception, "wait", wait)
    assert list(data) == []
    assert waits != []
    assert None not in waits


def test_a_function_gets_each_frame_until_it_is_closed() -> None:
    data = Fed()
    found: list[int] = []

    def take(each: Frame) -> None:
        found.append(each.sequence)
        if len(found) == 3:
            data.close()

    data.on_frame(take)
    data.feed([parameters(xml()), *(ones(MARKERS, number) for number in range(3))])
    assert list(_numbers(data)) == []  # ends when the function has closed it
    assert found == [0, 1, 2]


def _numbers(data: Live) -> Iterator[int]:
    while not data._is_closed:
        data._reception.wait(data._reception.num_changes, 0.01)
    yield from (each.sequence for each in data)


@pytest.mark.parametrize(
    ("differences_us", "offset_us"),
    [([500, 900], 0), ([-3_000, -2_000], -3_000), ([5_000_000, 4_000_000], 4_000_000)],
)
def test_the_clock_of_another_computer_is_taken_out(differences_us: list[int], offset_us: int) -> None:
    clock = ClockDifference()
    for number, difference_us in enumerate(differences_us):
        clock.add("3d", Sent(START_UTIME + number, 1, number, number + difference_us))
    clock.follow(START_UTIME)
    assert clock.offset_us == offset_us
    assert clock.steady_offset_us == offset_us - START_UTIME


def test_a_gateway_that_starts_again_after_its_clock_was_set_back_is_not_taken_for_late_messages() -> None:
    """It may have the same session, and lower numbers and times, as messages that were overtaken have."""
    clock = ClockDifference()
    clock.add("3d", Sent(START_UTIME, 1, 100, 0))
    for number in range(40):
        arrived_us = (number + 1) * 100_000
        clock.add("3d", Sent(START_UTIME - 3_600_000_000 + arrived_us, 1, number, arrived_us))
    clock.follow(START_UTIME)
    assert clock.offset_us == 3_600_000_000


_STEPS = st.sampled_from([0, 0, 0, 0, -86_400_000_000, -3_000_000, 60_000, 3_000_000, 86_400_000_000])


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["3d", "analog"]),
            *(_STEPS, _STEPS),
            st.integers(0, 9_000),
            st.sampled_from(["next", "next", "next", "late", "restart"]),
        ),
        max_size=60,
    )
)
def test_the_difference_of_two_clocks_is_right_whichever_is_set(
    messages: list[tuple[str, int, int, int, str]],
) -> None:
    """A model: two keys, delays below 9 ms, late messages, restarts of the gateway, and steps of both clocks.

    The difference is right as soon as each key that has come before the step has come after it.
    """
    clock, now_us, gateway_us, host_us = ClockDifference(), 0, START_UTIME, START_UTIME + 40_000_000
    session, numbers, stale = 1, {"3d": 0, "analog": 0}, set[str]()
    for key, gateway_step_us, host_step_us, delay_us, what in messages:
        now_us += 10_000
        if gateway_step_us < 0:
            stale = {each for each, number in numbers.items() if number}
        gateway_us, host_us = gateway_us + gateway_step_us, host_us + host_step_us
        if what == "restart":
            session += 1
            numbers = dict.fromkeys(numbers, 1)
        if what == "late" and numbers[key] and gateway_step_us == 0 and key not in stale:
            late = Sent(gateway_us + now_us - 15_000, session, numbers[key] - 1, now_us)
            clock.add(key, late)
        numbers[key] += 1
        clock.add(key, Sent(gateway_us + now_us, session, numbers[key], now_us + delay_us))
        stale.discard(key)
        clock.follow(host_us)
        if not stale:
            assert abs(clock.offset_us - (host_us - gateway_us)) <= ClockDifference.SAME_US


@pytest.mark.parametrize("num_before", [1, 15, 16, 17, 40])
def test_the_newest_parameters_are_kept_when_the_clock_was_set_back(num_before: int) -> None:
    """Only 16 are kept of a source: the oldest go, by their arrival and not by their times."""
    data = Fed("lab")
    for version in range(1, num_before + 1):
        data.feed([parameters(xml(f"m{version}"), version, utime=START_UTIME + version)])
        data.parameters()
    for version in range(num_before + 1, num_before + 4):
        data.feed([parameters(xml(f"m{version}"), version, utime=START_UTIME - 3_600_000_000 + version)])
        data.parameters()
        data.feed([ones(MARKERS, version, 1, version=version)])
        assert data.frames(1)[0].markers.labels == (f"m{version}",)


@pytest.mark.parametrize("components", [["4d"], "4d", "3", ["3d", "d"]])
def test_an_unknown_component_is_refused(components: Any) -> None:
    with raises(SelectionError, *COMPONENTS_BY_KEY):
        live("lab", components=components)


def test_a_misspelt_component_names_the_similar_one() -> None:
    """``latest`` would return None for ever, as if nothing had arrived yet."""
    with raises(SelectionError, "'3d'"):
        live("lab", components=["3D"])
    with raises(SelectionError, "'3d'"):
        live("lab").latest("3D")


@pytest.mark.parametrize(
    ("sources", "options"),
    [
        ([["lab", "stage"]], {}),
        ([""], {}),
        (["lab*"], {}),
        ([], {"last_s": -1}),
        ([], {"last_s": float("nan")}),
        ([], {"last_s": "5"}),
        ([], {"prefix": "a b*"}),
        ([], {"prefix": "mocap/x", "lcm": True}),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_opened(
    sources: list[Any], options: dict[str, Any]
) -> None:
    """Otherwise, a program would wait for ever, or get an error of Zenoh that names no argument."""
    with pytest.raises(SelectionError):
        live(*sources, **options)


def test_other_prefixes_and_an_empty_past_are_accepted() -> None:
    live("lab", "stage_2", prefix="site/mocap", last_s=0)
    live(prefix="MOCAP2", lcm=True)
    live(prefix="")


def test_values_are_numpy_arrays_without_a_copy() -> None:
    data = Fed()
    data.feed([parameters(xml()), ones(MARKERS, 1)])
    [found] = data.frames(1)
    assert np.shares_memory(found.markers.positions, found.markers.items)
