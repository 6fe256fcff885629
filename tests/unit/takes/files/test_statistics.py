"""``take_statistics``: what a take contains, what is missing, and where the clock was set."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rtc3d

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import EventDefinition, Marker, Parameters, Parameters3D, ParametersEvents
from gateway.takes.files import event_log, reader
from gateway.takes.files.component_statistics import MAX_LISTED_STEPS, ClockSteps, ComponentStatistics
from gateway.takes.files.statistics import SourceStatistics, take_statistics
from tests.support.errors import names
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    frame,
    log_bytes,
    markers,
    parameters,
    write_take,
)

NAN = math.nan


def labelled(*labels: str) -> Parameters:
    all_markers = tuple(Marker(str(number), label) for number, label in enumerate(labels))
    return Parameters(markers=Parameters3D(100.0, "mm", all_markers))


def lab(path: Path, messages: list[Message]) -> SourceStatistics:
    return take_statistics(write_take(path / "take.lcmlog", messages)).sources["lab"]


def markers_of(path: Path, messages: list[Message]) -> ComponentStatistics:
    return lab(path, messages).components["3d"]


def status(sequence: int, lost: int) -> Message:
    message = rtc3d.status_t()
    message.utime, message.sequence = START_UTIME + sequence * 1_000_000, sequence
    message.source, message.server, message.gateway_version = "lab", "192.0.2.20:3020", "2.0"
    output = rtc3d.output_status_t()
    output.name = "zenoh"
    loss = rtc3d.loss_t()
    loss.cause, loss.messages = "closed", lost
    output.drops, output.num_drops = [loss], 1
    message.outputs, message.num_outputs = [output], 1
    return "MOCAP_LAB_STATUS", message.encode()


def test_a_complete_take(tmp_path: Path) -> None:
    messages = [description(), parameters(labelled("a", "b"))]
    for number in range(201):
        second = (1, NAN, 3, 999) if number % 4 else (1, 2, 3, 0)
        messages.append(frame(ComponentType.MARKERS, [(1, 2, 3, NAN), second], number))
    statistics = take_statistics(write_take(tmp_path / "take.lcmlog", messages))
    source = statistics.sources["lab"]
    found = source.components["3d"]
    assert statistics.is_complete
    assert (statistics.seconds, statistics.num_messages) == (2.0, 203)
    assert (source.origin.servers, source.origin.gateway_versions) == (["192.0.2.20:3020"], ["1.0"])
    assert source.origin.take_name == "take"
    assert (source.sessions, source.server_restarts, source.gateway_restarts) == (1, 0, 0)
    assert (found.num_messages, found.min_items, found.max_items, found.rate_hz) == (201, 2, 2, 100.0)
    assert (source.announced_hz("3d"), source.announced_hz("6d")) == (100.0, None)
    assert found.visibility == {"a": 1.0, "b": 51 / 201}
    assert [change.text for change in source.parameters.changes] == ["first: 3d"]


def test_the_rate_is_that_of_frames_that_follow_each_other(tmp_path: Path) -> None:
    """With a pause, a loss or a lost connection in it, a server would seem to be slower than it is."""
    messages = [markers(1, 0), markers(1, 1), markers(1, 2, timestamp_us=1_010_001)]
    messages += [markers(1, 4, timestamp_us=1_510_001), markers(1, 5, timestamp_us=2_010_001, session=2)]
    assert markers_of(tmp_path, messages).rate_hz == 100.0
    assert markers_of(tmp_path, [markers(1, number, timestamp_us=0) for number in range(3)]).rate_hz == 100.0


def test_damaged_numbers_are_neither_gaps_nor_restarts(tmp_path: Path) -> None:
    numbers = (0, 1, 2**62, 2, -5, 3, -(2**63), 5)
    messages = [
        markers(1, number, utime=START_UTIME + place, timestamp_us=place, frame_number=place)
        for place, number in enumerate(numbers)
    ]
    gaps = markers_of(tmp_path, messages).gaps
    assert (gaps.num_lost, gaps.num_gaps, gaps.num_implausible, gaps.num_restarts) == (1, 1, 3, 0)


@pytest.mark.parametrize("batch_bytes", [1, 1_000_000])
def test_restarts_of_server_and_gateway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch_bytes: int
) -> None:
    """They count between two parts that are read at once, too."""
    monkeypatch.setattr(reader, "_BATCH_BYTES", batch_bytes)
    monkeypatch.setattr(event_log, "_READ_BYTES", batch_bytes)
    messages = [
        markers(1, 0),
        markers(1, 1),
        markers(1, 2, timestamp_us=5, session=2),
        markers(1, 3, session=2),
    ]
    messages += [markers(1, 0, utime=START_UTIME + 10**6, timestamp_us=50_000, frame_number=5)]
    source = lab(tmp_path, messages)
    assert (source.sessions, source.server_restarts, source.gateway_restarts) == (2, 1, 1)
    assert source.components["3d"].gaps.num_lost == 0


def test_changes_of_parameters_say_what_changed(tmp_path: Path) -> None:
    renamed = parameters(labelled("a", "c"), 2)
    messages = [parameters(labelled("a", "b")), markers(2, 0), renamed, renamed, markers(2, 1, version=2)]
    messages += [parameters(b"", 3), markers(1, 2, version=3)]
    source = lab(tmp_path, messages)
    texts = [(change.version, change.text) for change in source.parameters.changes]
    assert texts[:2] == [(1, "first: 3d"), (2, "3d 'b' to 'c'")]
    [(version, text)] = texts[2:]
    assert version == 3
    assert names(text, "no parameters")
    assert source.components["3d"].visibility == {"a": 1, "b": 1, "c": 1, "marker 1": 1}


def test_versions_that_start_again_with_the_gateway_keep_their_own_labels(tmp_path: Path) -> None:
    again = parameters(labelled("b"), 1, utime=START_UTIME + 15_000)
    source = lab(tmp_path, [parameters(labelled("a"), 1), markers(1, 0), again, markers(1, 2)])
    assert source.components["3d"].visibility == {"a": 1, "b": 1}


def test_each_of_many_versions_keeps_its_labels(tmp_path: Path) -> None:
    """The memory is bounded; a day of changes is no reason to forget what came before."""
    messages = [
        each for v in range(40) for each in (parameters(labelled(f"{v}"), v), markers(1, v, version=v))
    ]
    assert markers_of(tmp_path, messages).visibility == {f"{v}": 1 for v in range(40)}


def test_events_are_counted_by_id_with_their_labels(tmp_path: Path) -> None:
    events = [(7, 0, -1, -1, -1), (16, 0, -1, -1, -1), (7, 0, -1, -1, -1)]
    definition = Parameters(events=ParametersEvents((EventDefinition("0x10", "jump"),)))
    source = lab(tmp_path, [parameters(definition), frame(ComponentType.EVENT, events)])
    assert source.components["event"].event_counts == {7: 2, 16: 1}
    assert source.parameters.event_labels == {16: "jump"}
    many = lab(tmp_path, [frame(ComponentType.EVENT, [(number, 0, -1, -1, -1) for number in range(1005)])])
    assert (len(many.components["event"].event_counts), many.components["event"].other_events) == (1000, 5)


def test_what_the_gateway_lost_during_the_take_is_counted_from_its_beginning(tmp_path: Path) -> None:
    # It lost 10 before the take, 3 during it, and 2 after it started again.
    source = lab(tmp_path, [status(0, 10), status(1, 10), status(2, 13), status(3, 2)])
    assert source.gateway_losses.counts == {("zenoh", "closed"): 5}
    assert (source.origin.servers, source.origin.gateway_versions) == (["192.0.2.20:3020"], ["2.0"])


def test_steps_of_the_clock_are_found_and_pauses_of_the_network_are_not(tmp_path: Path) -> None:
    def utime(number: int) -> int:
        time_us = START_UTIME + number * 10_000
        if 1000 <= number < 1300:  # everything arrives at once, up to 3 s late
            return START_UTIME + 13_000_000 + number
        return time_us - 3_600_000_000 if number >= 2500 else time_us

    messages = [
        frame(component, [], number, utime=utime(number))
        for number in range(4000)
        for component in (ComponentType.MARKERS, ComponentType.TOOLS)
    ]
    steps = lab(tmp_path, messages).clock_steps
    assert [(step.step_us, step.utime) for step in steps.steps] == [(-3_600_000_000, utime(2500))]


def test_damage_and_foreign_messages_are_reported(tmp_path: Path) -> None:
    log = log_bytes([markers(1, number) for number in range(4)] + [("OTHER", bytes(8)), ("OTHER", b"x")])
    size = len(log_bytes([markers(1, 0)]))
    path = tmp_path / "take.lcmlog"
    path.write_bytes(log[:size] + b"garbage" + log[size:-1])
    statistics = take_statistics(path)
    assert statistics.unknown == {"OTHER": 1}
    places = [(size, 7), (len(log) + 7 - 28 - 5 - 1, 33)]
    assert [(place.offset, place.num_bytes) for place in statistics.damage] == places
    assert (statistics.num_damaged, statistics.damaged_bytes, statistics.is_complete) == (2, 40, False)


def test_a_status_of_an_earlier_version_is_counted_and_leaves_the_rest(tmp_path: Path) -> None:
    earlier = bytes.fromhex("3d9c34c617e4ba2e") + bytes(40)  # the fingerprint of status_t in 0.1.0
    messages = [markers(2, 0), ("MOCAP_LAB_STATUS", earlier), markers(2, 1)]
    statistics = take_statistics(write_take(tmp_path / "earlier.lcmlog", messages))
    assert statistics.unknown == {"MOCAP_LAB_STATUS": 1}
    assert statistics.sources["lab"].components["3d"].num_messages == 2


@pytest.mark.parametrize(
    "lost",
    [
        [],
        [("MOCAP_LAB_3D", markers(1, 1)[1][:-1]), markers(1, 1)],
        [("MOCAP_LAB_STATUS", status(0, 0)[1][:-1]), markers(1, 1)],
    ],
)
def test_a_gap_or_a_message_that_cannot_be_read_makes_a_take_incomplete(
    tmp_path: Path, lost: list[Message]
) -> None:
    """Whoever analyses a take must be able to rely on this answer."""
    path = write_take(tmp_path / "take.lcmlog", [markers(1, 0), *lost, markers(1, 2)])
    statistics = take_statistics(path)
    assert not statistics.is_complete
    assert statistics.seconds == 0.02


# Steps of the clock, in arrays of any division -------------------------------------------------

SECOND_US = 1_000_000


def steps_of(delays_us: list[int], per_window: int = 4) -> ClockSteps:
    """Return the steps if the frames of each second arrive with these delays; the last is the latest one."""
    found = ClockSteps()
    for second, delay_us in enumerate(delays_us):
        stamps = np.arange(per_window, dtype=np.int64) * SECOND_US // per_window + second * SECOND_US
        utimes = stamps + delay_us
        found.add(utimes[:1], stamps[:1])
        late_us = np.arange(per_window - 1) * 900_000  # the first one of a second counts
        found.add(utimes[1:] + late_us, stamps[1:])
    found.add(np.array([], np.int64), np.array([], np.int64))
    return found


@pytest.mark.parametrize(
    ("delays_us", "expected"),
    [
        ([0] * 20, []),
        ([0] * 5 + [2 * SECOND_US] * 6, [(7.0, 2 * SECOND_US)]),
        ([0] * 5 + [2 * SECOND_US] * 5, []),  # the last second may not be complete
        ([0] * 5 + [2 * SECOND_US] * 4 + [0] * 5, []),  # a stall
        ([0] * 5 + [499_999] * 10, []),  # like frames that arrive late
        ([0] * 5 + [500_000] * 10, [(5.5, 500_000)]),
        ([0] * 5 + [-3_600 * SECOND_US] * 6, [(-3_595.0, -3_600 * SECOND_US)]),
        ([0] * 5 + [number * SECOND_US for number in range(1, 12)] + [0] * 9, []),  # a network that clogs
        ([0] * 5 + [2 * SECOND_US] * 6 + [0] * 6, [(7.0, 2 * SECOND_US), (11.0, -2 * SECOND_US)]),
    ],
)
def test_a_step_of_the_clock_is_told_from_a_stall(
    delays_us: list[int], expected: list[tuple[float, int]]
) -> None:
    """A clock that was set bends every time in the take; a stall only looks like it."""
    steps = steps_of(delays_us).steps
    assert [(step.utime / SECOND_US, step.step_us) for step in steps] == expected


def test_after_a_long_pause_the_clock_is_compared_anew() -> None:
    """Two clocks drift apart in a pause; a minute is the limit."""

    def steps_after(pause: int) -> int:
        found = ClockSteps()
        for second in (*range(10), *range(9 + pause, 20 + pause)):
            delay = 0 if second < 10 else 2 * SECOND_US
            stamp = np.array([second * SECOND_US], np.int64)
            found.add(stamp + delay, stamp)
        return found.num_steps

    assert [steps_after(pause) for pause in (1, 60, 61)] == [1, 1, 0]


def test_of_a_second_that_is_read_in_two_parts_the_earliest_frame_counts() -> None:
    """Frames that the network delayed must not look like a step of the clock where a batch ends."""
    steps = ClockSteps()
    for second in range(40):
        for part_us, delay_us in ((0, 0), (500_000, 5_000_000 * (second >= 20))):
            timestamp_us = 1_000_000 * second + part_us
            steps.add(np.array([10**15 + timestamp_us + delay_us]), np.array([timestamp_us]))
    assert steps.num_steps == 0


def test_listed_steps_are_bounded() -> None:
    """A clock that jumps all night must not fill the memory."""
    delays = [2 * SECOND_US * (window // 5 % 2) for window in range(5 * 104 + 1)]
    found = steps_of(delays)
    assert (len(found.steps), found.num_steps) == (MAX_LISTED_STEPS, 103)
    assert all(first.step_us == -second.step_us for first, second in pairwise(found.steps))
