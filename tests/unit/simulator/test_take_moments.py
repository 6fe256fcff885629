"""The times of recorded components, and the moments that they make."""

import struct
from collections.abc import Iterable

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.take_moments import Moment, MomentBuilder, RecordedParameters, TakeTimeline

START = 1_700_000_000_000_000
PERIOD_US = 10_000
MARKERS, TOOLS = ComponentType.MARKERS, ComponentType.TOOLS
ANALOG, EVENT = ComponentType.ANALOG, ComponentType.EVENT
PARAMETERS = RecordedParameters(b"<RT_Parameters/>")
Content = dict[ComponentType, int]


class Take:
    """Components added one after the other, each with another frame number."""

    def __init__(self) -> None:
        self.builder = MomentBuilder()
        self.moments: list[Moment] = []
        self._number = 0

    def add(
        self, kind: ComponentType, time_us: int, capture_us: int = -1, session: int = 1, stamp: bytes = b""
    ) -> None:
        captured = START + (time_us if capture_us == -1 else capture_us)
        self._number += 1
        content = struct.pack(">iqi", self._number, time_us, 0)
        stamp = stamp or self._number.to_bytes(4, "big")
        self.moments += self.builder.add(kind, captured, session, stamp, content, PARAMETERS)

    def finish(self) -> list[tuple[int, Content]]:
        """Return the time and the frame numbers of each moment."""
        self.moments += self.builder.finish()
        return [(each.due_us, {k: number_in(v) for k, v in each.contents.items()}) for each in self.moments]


def number_in(content: bytes) -> int:
    return int(struct.unpack_from(">i", content)[0])


def test_components_of_one_time_stamp_or_one_frame_are_one_moment() -> None:
    """Whatever the connection of the first, and whatever the time stamps of the second."""
    expected: list[tuple[int, Content]] = [(0, {MARKERS: 1, ANALOG: 2}), (10_000, {MARKERS: 3, ANALOG: 4})]
    take = Take()
    for timestamp_us in (0, 10_000):
        take.add(MARKERS, timestamp_us, session=1)
        take.add(ANALOG, timestamp_us, session=2, capture_us=timestamp_us + 3000)
    assert take.finish() == expected
    take = Take()
    for number in (0, 1):
        take.add(MARKERS, number * 10_000, stamp=b"%d" % number)
        take.add(ANALOG, number * 10_000 + 300, stamp=b"%d" % number)
    assert take.finish() == expected


def test_a_component_that_arrives_late_on_another_connection_gets_its_place() -> None:
    take = Take()
    for timestamp_us in (0, 10_000, 20_000):
        take.add(MARKERS, timestamp_us, session=1)
    for timestamp_us in (0, 5000, 10_000):
        take.add(ANALOG, timestamp_us, session=2)
    assert take.finish() == [
        (0, {MARKERS: 1, ANALOG: 4}),
        (5000, {ANALOG: 5}),
        (10_000, {MARKERS: 2, ANALOG: 6}),
        (20_000, {MARKERS: 3}),
    ]


@pytest.mark.parametrize("timestamp_us", [0, -1, 77])
def test_with_frozen_time_stamps_each_component_is_in_a_frame_once(timestamp_us: int) -> None:
    take = Take()
    for captured in (0, 10_000, 20_000):
        take.add(MARKERS, timestamp_us, captured, stamp=b"%d" % captured)
        take.add(TOOLS, timestamp_us, captured, stamp=b"%d" % captured)
    frames = [(0, {MARKERS: 1, TOOLS: 2}), (10_000, {MARKERS: 3, TOOLS: 4}), (20_000, {MARKERS: 5, TOOLS: 6})]
    assert take.finish() == frames


def test_the_order_of_a_component_never_changes_and_no_two_moments_have_the_same_time() -> None:
    take = Take()
    stamps = [0, 0, 10_000, 5000, 5000, 3_000_000, 20_000, 2**60, 30_000, -5, 40_000]
    for captured, timestamp_us in enumerate(stamps):
        take.add(ANALOG, timestamp_us, captured * 1000)
    moments = take.finish()
    assert [content[ANALOG] for _, content in moments] == list(range(1, len(stamps) + 1))
    times = [time for time, _ in moments]
    assert times == sorted(set(times))


def test_a_time_stamp_that_returns_after_a_restart_does_not_join_the_old_moment() -> None:
    take = Take()
    take.add(MARKERS, 1000, 0)
    take.add(TOOLS, 1000, 5_000_000, session=2)
    assert [len(content) for _, content in take.finish()] == [1, 1]


def test_a_component_that_comes_after_its_moment_was_released_is_a_moment_of_its_own() -> None:
    """A moment that was released may have been sent already, and must not change any more."""
    take = Take()
    for timestamp_us in (0, 560_000):
        take.add(MARKERS, timestamp_us)
    assert len(take.moments) == 1
    take.add(TOOLS, 0, stamp=b"other")
    assert take.finish() == [(0, {MARKERS: 1}), (1, {TOOLS: 3}), (560_000, {MARKERS: 2})]


def test_moments_are_released_while_the_take_goes_on_even_if_all_have_one_time() -> None:
    for count, kind, period_us, at_once in ((1000, MARKERS, 10_000, 900), (30_000, EVENT, 0, 10_000)):
        take = Take()
        for number in range(count):
            take.add(kind, number * period_us)
        assert at_once < len(take.moments) < count
        assert len(take.finish()) == count


# Times --------------------------------------------------------------------------------------


def times(messages: Iterable[tuple[int, int]]) -> list[int]:
    """Return the times of (time stamp, time of capture since START) of one component."""
    timeline = TakeTimeline()
    return [timeline.time_us(MARKERS, 1, stamp, START + captured) for stamp, captured in messages]


def regular(count: int, first_us: int = 0) -> list[int]:
    return list(range(first_us, first_us + count * PERIOD_US, PERIOD_US))


def test_time_stamps_count_while_capture_times_agree_with_them() -> None:
    jitter = [0, 7000, -3000, 40_000, 1000] * 60
    messages = [(5_000_000 + k * PERIOD_US, k * PERIOD_US + jitter[k]) for k in range(300)]
    assert times(messages) == regular(300)


def test_all_components_share_the_clock_of_the_server() -> None:
    timeline = TakeTimeline()
    assert timeline.time_us(MARKERS, 1, 1_000_000, START) == 0
    assert timeline.time_us(ANALOG, 2, 1_000_500, START + 30_000) == 500


def test_clocks_may_drift_apart_and_time_stamps_wrap_around() -> None:
    messages = [(k * PERIOD_US, round(k * PERIOD_US * 1.0005)) for k in range(100_000)]
    assert times(messages)[-1] == 99_999 * PERIOD_US
    assert times(((2**32 - 1_000_000 + time) % 2**32, time) for time in regular(300)) == regular(300)


@pytest.mark.parametrize("stamp", [0, -1, 5_000_000, -(2**63)])
def test_frozen_time_stamps_are_no_clock(stamp: int) -> None:
    assert times([(stamp, time) for time in regular(300)]) == regular(300)


@pytest.mark.parametrize("step", [-3_600_000_000, -400_000, 400_000, 3_600_000_000])
def test_a_recording_computer_whose_clock_was_set_does_not_matter(step: int) -> None:
    assert times((time, time + (step if k >= 100 else 0)) for k, time in enumerate(regular(300))) == regular(
        300
    )


@pytest.mark.parametrize("unit", [0.001, 1000, 1.5, 0.7])
def test_time_stamps_of_another_unit_are_no_clock(unit: float) -> None:
    placed = times([(round(k * PERIOD_US * unit), k * PERIOD_US) for k in range(1000)])
    assert placed[600:] == regular(400, placed[600])
    assert all(abs(time - k * PERIOD_US) <= 260_000 for k, time in enumerate(placed))


@pytest.mark.parametrize("restart", [0, 3_000_000, 2**40])
def test_after_a_restart_of_the_server_the_time_goes_on(restart: int) -> None:
    before = [(7_000_000 + time, time) for time in regular(200)]
    after = [(restart + time, 5_000_000 + time) for time in regular(200)]
    assert times(before + after) == regular(200) + regular(200, 5_000_000)


def test_the_clock_may_be_set_back_when_two_components_follow() -> None:
    timeline = TakeTimeline()
    placed = []
    for k in range(300):
        captured = START + k * PERIOD_US - (3_600_000_000 if k >= 100 else 0)
        placed.append(timeline.time_us(MARKERS, 1, k * PERIOD_US, captured))
        assert timeline.time_us(ANALOG, 2, k * PERIOD_US, captured + 100) == placed[-1]
    assert placed == regular(300)


@pytest.mark.parametrize("step", [-(10**15), -3_600_000_000, 10**15])
@pytest.mark.parametrize("restart", [-1_000_000, 3_000_000])
def test_the_clock_may_be_set_while_the_server_restarts(restart: int, step: int) -> None:
    before = [(time, time) for time in regular(200)]
    after = [(restart + time, 2_000_000 + step + time) for time in regular(200)]
    placed = times(before + after)
    assert placed[:200] == regular(200)
    assert placed[200:] == regular(200, placed[200])
    assert placed[200] - placed[199] <= PERIOD_US


def test_a_damaged_time_delays_nothing() -> None:
    messages = [(time, time) for time in regular(300)]
    messages[100] = (-(2**62), 2**62)
    placed = times(messages)
    assert placed[:100] == regular(100)
    assert placed[150:] == regular(150, placed[150])
    assert abs(placed[150] - 150 * PERIOD_US) <= 2 * PERIOD_US
