"""The pace of a backlog, which frames are published at once, and when reading from the server is paused."""

import asyncio
from typing import cast

import pytest

from gateway.rtc3d.frames import RawFrame, split_frame
from gateway.session.backlog import MAX_TOGETHER, Backlog
from gateway.session.clock import ServerClock
from gateway.session.process_clock import running_clock
from tests.support.clocks import read_clocks, stop_process, until
from tests.support.servers import markers_frame

UTIME = 1_700_000_000_000_000
MS = 0.001


def frame(timestamp_ms: int) -> RawFrame:
    return split_frame(markers_frame(timestamp_ms, (0.0, 0.0, 0.0))[8:], "big")


def frames(count: int, first_ms: int = 0, step_ms: int = 1) -> list[RawFrame]:
    return [frame(first_ms + step_ms * number) for number in range(count)]


class Subscriber:
    """A backlog on a clock that only the tests advance, and without timers: ``run`` calls instead of them.

    ``published`` has each frame's number, and when it was published, in s.
    """

    def __init__(self, speed: float | None = 2.0) -> None:
        self.now_s = 100.0
        self.arrived_us = 0
        self.costs_s = 0.0
        """How long it takes to publish one frame."""
        self.published: list[tuple[int, float]] = []
        self.clock = ServerClock()
        self.clock.has_clock = True
        self.backlog = Backlog(self._publish, self.clock, speed, self.read_clocks, print, print)
        self.backlog._timer = cast("asyncio.Handle", self)

    def read_clocks(self) -> tuple[int, int]:
        """Do the same as HostClock.read."""
        return UTIME, round(1e6 * self.now_s)

    def _publish(self, published: list[RawFrame], utime: int, steady_us: int) -> None:
        assert utime == UTIME
        assert steady_us == self.arrived_us
        for each in published:
            self.published.append((each.number_and_timestamp[0], self.now_s - 100.0))
            self.now_s += self.costs_s

    def arrive(self, arrived: list[RawFrame]) -> None:
        self.arrived_us = self.read_clocks()[1]
        self.backlog.receive(arrived, *self.read_clocks())

    def run(self, late_s: float = 0.0) -> None:
        """Publish everything that waits, with every call ``late_s`` later than asked for."""
        while (wait_s := self.backlog._publish_due()) is not None:
            self.now_s += max(wait_s, 1e-6) + late_s  # the clock has whole µs

    @property
    def numbers(self) -> list[int]:
        return [number for number, _ in self.published]

    @property
    def times_ms(self) -> list[float]:
        return [round(1000 * time_s, 3) for _, time_s in self.published]


@pytest.mark.parametrize("speed", [1.5, 2.0, 10.0])
def test_a_backlog_is_published_at_a_multiple_of_the_streams_rate(speed: float) -> None:
    subscriber = Subscriber(speed)
    subscriber.arrive(frames(1000))
    subscriber.run()
    assert subscriber.numbers == list(range(1000))
    early_ms = [number / speed - time_ms for number, time_ms in enumerate(subscriber.times_ms)]
    assert min(early_ms) > -0.01
    assert max(early_ms) < 2, "timers have whole milliseconds"


def test_the_pace_continues_from_one_read_to_the_next() -> None:
    subscriber = Subscriber()
    for first in range(0, 1000, 100):
        subscriber.arrive(frames(100, first))
        subscriber.run()
    assert subscriber.numbers == list(range(1000))
    assert subscriber.times_ms[-1] == pytest.approx(500, abs=2)


def test_frames_that_arrive_while_others_wait_follow_them() -> None:
    subscriber = Subscriber()
    subscriber.arrive(frames(20))
    subscriber.backlog._publish_due()
    subscriber.arrive(frames(20, 20))
    subscriber.run()
    assert subscriber.numbers == list(range(40))


def test_a_stream_that_arrives_in_batches_is_not_delayed() -> None:
    """After the first batch, the time since the last one pays for the next."""
    subscriber = Subscriber()
    for first in range(0, 100, 10):
        arrived_s = subscriber.now_s
        subscriber.arrive(frames(10, first))
        subscriber.run()
        if first:
            assert subscriber.now_s == arrived_s
        subscriber.now_s = arrived_s + 10 * MS


@pytest.mark.parametrize(("pause_s", "continues"), [(0.49, True), (0.51, False)])
def test_a_pace_ends_after_half_a_second_without_a_backlog(pause_s: float, *, continues: bool) -> None:
    """Later frames begin a new pace: the first is due at once, and so is the one after it."""
    subscriber = Subscriber(speed=1.0)
    subscriber.arrive(frames(5))
    subscriber.run()
    subscriber.now_s = 100.004 + pause_s
    subscriber.arrive(frames(40, 5))
    subscriber.backlog._publish_due()
    late_ms = 15  # what a continued pace makes up for
    assert (len(subscriber.numbers) - 5 > late_ms) is continues


def test_a_backlog_after_a_pause_does_not_wait_for_the_time_of_the_pause() -> None:
    """The time stamps before the pause say nothing about when its second frame is due."""
    subscriber = Subscriber(speed=1.0)
    subscriber.arrive(frames(10))
    subscriber.run()
    subscriber.now_s = 200.0
    subscriber.published.clear()
    subscriber.arrive(frames(10, first_ms=100_000))
    subscriber.run()
    assert subscriber.times_ms == pytest.approx(
        [100_000 + max(0, number - 1) for number in range(10)], abs=0.1
    )


def test_a_stream_as_fast_as_the_gateway_is_never_throttled() -> None:
    """Every read has more frames than one publishes at once, and publishing takes as long as measuring."""
    subscriber = Subscriber()
    subscriber.costs_s = 1 * MS
    for first in range(0, 1000, 100):
        subscriber.arrive(frames(100, first))
        subscriber.run()
    assert subscriber.times_ms[-1] == pytest.approx(999, abs=2)


@pytest.mark.parametrize("late_ms", [1, 5, 20])
def test_an_event_loop_whose_timers_are_late_keeps_the_pace(late_ms: int) -> None:
    subscriber = Subscriber()
    subscriber.arrive(frames(1000))
    subscriber.run(late_ms * MS)
    expected_ms = 500 if late_ms <= 15 else 500 * late_ms / 15
    assert subscriber.times_ms[-1] == pytest.approx(expected_ms, rel=0.1)
    assert subscriber.times_ms[-1] < 1000, "slower than the stream itself"


@pytest.mark.parametrize(("costs_s", "at_once"), [(0.0, 32), (MS, 16)])
def test_a_second_stop_does_not_lead_to_a_burst(costs_s: float, at_once: int) -> None:
    subscriber = Subscriber()
    subscriber.costs_s = costs_s
    subscriber.arrive(frames(1000))
    subscriber.backlog._publish_due()
    subscriber.now_s += 5.0
    before = len(subscriber.published)
    subscriber.backlog._publish_due()
    assert len(subscriber.published) - before <= at_once


def test_a_restart_within_a_backlog_does_not_lead_to_a_burst() -> None:
    subscriber = Subscriber()
    subscriber.arrive([frame(1_000_000), *frames(200)])
    subscriber.run()
    assert subscriber.times_ms[-1] == pytest.approx(100, abs=2)


@pytest.mark.parametrize(
    "timestamps_ms",
    [
        pytest.param([0, 1, 2, 3_600_000, 3_600_001], id="gap"),
        pytest.param([1000 * number for number in range(5)], id="slow"),
        pytest.param([5000, 5001, 0, 1, 2], id="back"),
        pytest.param([7] * 5, id="constant"),
    ],
)
def test_unusual_time_stamps_never_cost_more_than_5_ms(timestamps_ms: list[int]) -> None:
    subscriber = Subscriber()
    subscriber.arrive([frame(timestamp_ms) for timestamp_ms in timestamps_ms])
    subscriber.run()
    assert subscriber.numbers == timestamps_ms
    steps = [
        after - before for before, after in zip(subscriber.times_ms, subscriber.times_ms[1:], strict=False)
    ]
    assert max(steps) <= 5.001


def test_frames_without_components_have_no_time() -> None:
    subscriber = Subscriber()
    empty = split_frame(bytes(4), "big")
    subscriber.backlog._publish = lambda published, _utime, _steady_us: subscriber.published.extend(
        (-1, 0.0) for _ in published
    )
    subscriber.arrive([empty] * 10)
    subscriber.run()
    assert len(subscriber.published) == 10
    assert subscriber.now_s == 100.0


def test_without_a_clock_nothing_waits() -> None:
    subscriber = Subscriber()
    subscriber.clock.has_clock = False
    subscriber.arrive(frames(1000))
    subscriber.run()
    assert subscriber.times_ms == [0.0] * 1000


def test_one_call_publishes_only_for_a_while() -> None:
    subscriber = Subscriber()
    subscriber.clock.has_clock = False
    subscriber.costs_s = 0.02 * MS
    subscriber.arrive(frames(1000))
    assert subscriber.backlog._publish_due() == 0.0
    assert 100 <= len(subscriber.published) <= 100 + 64


@pytest.mark.parametrize(("costs_ms", "in_one_call"), [(0.13, 16), (0.6, 4), (1.5, 2), (7.0, 1)])
def test_one_call_publishes_few_frames_that_take_long(costs_ms: float, in_one_call: int) -> None:
    """As those of hundreds of tools do: other sources have their turn after 2 ms, or after one frame."""
    subscriber = Subscriber()
    subscriber.clock.has_clock = False
    subscriber.costs_s = costs_ms * MS
    subscriber.arrive(frames(1))
    subscriber.arrive(frames(100, 1))
    for first in range(1, 65, in_one_call):
        subscriber.published.clear()
        assert subscriber.backlog._publish_due() == 0.0
        assert subscriber.numbers == list(range(first, first + in_one_call))


def test_late_frames_that_are_skipped_come_in_large_chunks_although_the_last_one_takes_long() -> None:
    subscriber = Subscriber(speed=None)
    subscriber.costs_s = 7.0 * MS
    subscriber.arrive(frames(200))
    for end in (64, 128):
        assert subscriber.backlog._publish_due() == 0.0
        assert len(subscriber.published) == end


class Lab:
    """A backlog on the event loop, and what it calls. ``numbers`` are those of the published frames."""

    def __init__(self, *, has_pace: bool = True, frame_s: float = 0.0) -> None:
        self.frame_s = frame_s
        """How long it takes to publish a frame."""
        clock = ServerClock()
        clock.has_clock = has_pace
        self.numbers: list[int] = []
        self.waiting: list[bool] = []
        self.defects: list[Exception] = []
        self.defect: Exception | None = None
        """What publishing frames raises."""
        self.backlog = Backlog(
            self._on_frames, clock, 2.0, read_clocks, self.waiting.append, self.defects.append
        )

    def _on_frames(self, passed: list[RawFrame], _utime: int, _steady_us: int) -> None:
        if self.defect is not None:
            raise self.defect
        self.numbers += [each.number_and_timestamp[0] for each in passed]
        stop_process(self.frame_s * len(passed))

    def receive(self, count: int, first: int = 0) -> None:
        self.backlog.receive(frames(count, first), *read_clocks())


async def test_a_few_frames_together_are_passed_on_at_once() -> None:
    lab = Lab()
    lab.receive(MAX_TOGETHER)
    assert lab.numbers == list(range(MAX_TOGETHER))
    assert lab.waiting == []
    assert lab.backlog.caught_up_s == 0.0


async def test_a_few_frames_that_take_long_are_passed_on_one_by_one() -> None:
    """So that other sources have their turn in between."""
    lab = Lab(has_pace=False, frame_s=0.007)
    lab.receive(1)
    lab.receive(2, first=1)
    assert (lab.numbers, lab.waiting) == ([0, 1], [True])
    await until(lambda: not lab.waiting[-1])
    assert lab.numbers == [0, 1, 2]


async def test_reading_is_paused_until_a_backlog_is_passed_on() -> None:
    lab = Lab()
    lab.receive(1000)
    assert 0 < len(lab.numbers) < 1000
    assert lab.waiting == [True]
    await until(lambda: not lab.waiting[-1])
    assert lab.numbers == list(range(1000))
    assert running_clock().time() - lab.backlog.caught_up_s < 0.02


async def test_frames_that_arrive_during_a_backlog_wait_behind_it() -> None:
    lab = Lab()
    lab.receive(1000)
    lab.receive(1, first=1000)
    await until(lambda: not lab.waiting[-1])
    assert lab.numbers == list(range(1001))


async def test_without_a_pace_frames_wait_only_for_their_turn() -> None:
    lab = Lab(has_pace=False)
    lab.receive(1000)
    assert lab.numbers == list(range(1000))
    assert lab.waiting == [False]
    assert lab.backlog.is_empty


async def test_finishing_passes_on_everything_and_what_follows_at_once() -> None:
    lab = Lab()
    lab.receive(1000)
    lab.backlog.finish()
    assert lab.numbers == list(range(1000))
    lab.receive(1000, first=1000)
    assert lab.numbers == list(range(2000))
