"""Clocks that are set, restarts of the server, and time stamps that are not a clock."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from gateway.session.clock import ServerClock
from tests.support.clock_simulation import (
    EPOCH_UTIME,
    Times,
    delayed,
    learned,
    observe,
    percentile_95_us,
    simulate,
    whole_us,
)

RATE_HZ = 200
SECOND = RATE_HZ  # frames
LEARNED = 30 * SECOND
WRAP_US = 2**32


# --- clocks that are set


@pytest.mark.parametrize("by_s", [3600, 10, 0.3, 0.02, -0.02, -0.3, -10, -3600])
def test_a_host_clock_that_is_set_is_learned_again_within_three_seconds(by_s: float) -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ, drift_ppm=100)
    before, after = frames.part(0, LEARNED), frames.part(LEARNED).with_host_set(round(by_s * 1e6))
    clock = ServerClock()
    observed = observe(clock, before + after)
    assert not observed.restarted.any()
    assert observed.has_clock[LEARNED:].all()
    assert percentile_95_us(observed.errors_us[LEARNED + 3 * SECOND :]) < 200
    assert clock.drift_ppm == pytest.approx(100, abs=3)


def test_a_hiccup_does_not_delay_learning_the_new_host_clock() -> None:
    frames = delayed(simulate(seconds=60, rate_hz=RATE_HZ), RATE_HZ, [31, 31.1, 31.9, 32], [0, 0.3, 0.3, 0])
    set_s = 30
    after = frames.part(set_s * SECOND).with_host_set(10_000_000)
    observed = observe(ServerClock(), frames.part(0, set_s * SECOND) + after)
    assert percentile_95_us(observed.errors_us[(set_s + 5) * SECOND :]) < 200


@pytest.mark.parametrize("by_us", [60_000_000, 300_000])
def test_time_stamps_that_jump_forward_are_learned_again_at_once(by_us: int) -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    jump = by_us * (np.arange(len(frames)) >= LEARNED)
    observed = observe(ServerClock(), frames.with_timestamps(frames.timestamps_us + jump))
    assert not observed.restarted.any()
    assert (observed.captures_utime <= frames.arrivals_utime).all()
    assert percentile_95_us(observed.errors_us[LEARNED + SECOND :]) < 200


# --- another time base


@pytest.mark.parametrize("start_us", [0, 5_000_000])
def test_a_restarted_server_is_recognised_by_its_first_frame(start_us: int) -> None:
    before = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=100)
    after = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=100, seed=1, start_us=start_us)
    after = after.with_host_set(60_000_000)
    clock = learned(before)
    observed = observe(clock, after)
    assert observed.restarted.tolist() == [True] + (len(after) - 1) * [False]
    assert observed.captures_utime[0] == after.arrivals_utime[0]
    assert observed.has_clock.all()
    assert percentile_95_us(observed.errors_us[SECOND:]) < 100  # the drift was known


def test_a_frame_number_that_goes_back_is_a_restart_even_if_time_stamps_continue() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    clock = ServerClock()
    observe(clock, frames.part(0, LEARNED), first_frame_number=1000)
    restarted = observe(clock, frames.part(LEARNED), first_frame_number=0).restarted
    assert restarted.tolist() == [True] + (len(restarted) - 1) * [False]


def test_frame_numbers_may_be_constant() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    clock = ServerClock()
    readings = [
        clock.observe(timestamp_us, 0, arrival_utime)
        for timestamp_us, arrival_utime in zip(
            frames.timestamps_us.tolist(), frames.arrivals_utime.tolist(), strict=True
        )
    ]
    assert not any(restarted for _, _, restarted in readings)
    assert clock.has_clock


@pytest.mark.parametrize("lowest", [0, -(2**31)], ids=["unsigned", "signed"])
@pytest.mark.parametrize("seconds", [20.0, 20.1, 20.2, 20.3, 20.4])
def test_32_bit_time_stamps_that_wrap_around_do_not_disturb_the_clock(seconds: float, lowest: int) -> None:
    start_us = lowest + WRAP_US - round(seconds * 1e6)
    frames = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=-100, start_us=start_us)
    wrapped = frames.with_timestamps((frames.timestamps_us - lowest) % WRAP_US + lowest)
    assert (wrapped.timestamps_us[:-1] > wrapped.timestamps_us[1:]).sum() == 1
    clock, same = ServerClock(), ServerClock()
    observed = observe(clock, wrapped)
    assert not observed.restarted.any()
    assert observed.captures_utime.tolist() == observe(same, frames).captures_utime.tolist()
    assert clock.offset_us == same.offset_us + WRAP_US


def test_a_restart_after_a_wrap_around_forgets_the_wrapped_time() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ, start_us=WRAP_US - 20_000_000)
    clock = learned(frames.with_timestamps(frames.timestamps_us % WRAP_US))
    clock.observe(0, 0, EPOCH_UTIME + 60_000_000)
    assert clock.offset_us == EPOCH_UTIME + 60_000_000


def test_a_server_that_loops_a_file_restarts_each_time_and_keeps_its_clock() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    loop = 340  # frames: 1.7 s
    looped = frames.with_timestamps(frames.timestamps_us[np.arange(len(frames)) % loop])
    observed = observe(ServerClock(), looped)
    assert np.flatnonzero(observed.restarted).tolist() == list(range(loop, len(frames), loop))
    assert observed.has_clock[loop:].all()
    assert (observed.captures_utime <= looped.arrivals_utime).all()
    assert percentile_95_us(observed.errors_us[loop:]) < 2_000


# --- no clock


def random_stamps(timestamps_us: Times) -> Times:
    return np.random.default_rng(1).integers(-(2**63), 2**63 - 1, len(timestamps_us))


def times(factor: float) -> Callable[[Times], Times]:
    return lambda timestamps_us: whole_us(timestamps_us * factor)


@pytest.mark.parametrize(
    "stamped",
    [
        pytest.param(np.zeros_like, id="always 0"),
        pytest.param(lambda timestamps_us: np.full_like(timestamps_us, 2**62), id="constant"),
        pytest.param(random_stamps, id="random"),
        pytest.param(times(0.001), id="milliseconds"),
        pytest.param(times(1000), id="nanoseconds"),
        *(pytest.param(times(factor), id=f"{factor} times as fast") for factor in (0.5, 0.9, 1.1, 2)),
    ],
)
def test_unusable_time_stamps_are_not_a_clock(stamped: Callable[[Times], Times]) -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ)
    clock = ServerClock()
    observed = observe(clock, frames.with_timestamps(stamped(frames.timestamps_us)))
    assert not observed.has_clock.any()
    assert (observed.captures_utime == frames.arrivals_utime).all()
    assert not observed.lags_s.any()
    assert (clock.offset_us, clock.drift_ppm, clock.uncertainty_us) == (0, 0.0, math.inf)


@pytest.mark.parametrize("factor", [0.998, 1.002])
def test_a_rate_that_no_crystal_has_is_detected_within_ten_seconds(factor: float) -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ)
    observed = observe(ServerClock(), frames.with_timestamps(times(factor)(frames.timestamps_us)))
    assert not observed.has_clock[10 * SECOND :].any()


def test_the_drift_never_exceeds_that_of_crystals() -> None:
    frames = simulate(seconds=12, rate_hz=RATE_HZ)
    clock = ServerClock()
    # The drift is not large enough to rule out that the network is the cause.
    assert observe(clock, frames.with_timestamps(times(0.9991)(frames.timestamps_us))).has_clock[-1]
    assert clock.drift_ppm == 500


def test_a_time_stamp_that_freezes_ends_the_clock_until_it_moves_again() -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ)
    stamps = frames.timestamps_us.copy()
    stamps[LEARNED : LEARNED + 10 * SECOND] = stamps[LEARNED]
    frozen = frames.with_timestamps(stamps)
    observed = observe(ServerClock(), frozen)
    without = slice(LEARNED + round(0.6 * SECOND), LEARNED + 10 * SECOND)
    assert not observed.has_clock[without].any()
    assert (observed.captures_utime == frozen.arrivals_utime)[without].all()
    assert observed.has_clock[LEARNED + 12 * SECOND :].all()
    assert percentile_95_us(observed.errors_us[LEARNED + 12 * SECOND :]) < 200


@pytest.mark.parametrize("stamped", [random_stamps, times(0.9)], ids=["random", "0.9 times as fast"])
def test_there_is_a_clock_again_after_unusable_time_stamps(stamped: Callable[[Times], Times]) -> None:
    nonsense = simulate(seconds=40, rate_hz=RATE_HZ)
    clock = learned(nonsense.with_timestamps(stamped(nonsense.timestamps_us)))
    frames = simulate(seconds=40, rate_hz=RATE_HZ, start_us=0).with_host_set(40_000_000)
    observed = observe(clock, frames, first_frame_number=40 * SECOND)
    assert observed.has_clock[2 * SECOND :].all()
    assert percentile_95_us(observed.errors_us[2 * SECOND : 5 * SECOND]) < 500
    assert percentile_95_us(observed.errors_us[LEARNED:]) < 100


@pytest.mark.parametrize(
    ("stamped", "soon"),
    [
        pytest.param(lambda stamps_us: np.arange(len(stamps_us)) * 5, 2 * SECOND, id="milliseconds"),
        pytest.param(random_stamps, 10, id="restarts at nearly every frame"),
    ],
)
def test_a_server_that_restarts_with_unusable_time_stamps_soon_has_no_clock(
    stamped: Callable[[Times], Times], soon: int
) -> None:
    clock = learned(simulate(seconds=40, rate_hz=RATE_HZ))
    frames = simulate(seconds=20, rate_hz=RATE_HZ).with_host_set(60_000_000)
    nonsense = frames.with_timestamps(stamped(frames.timestamps_us))
    assert not observe(clock, nonsense).has_clock[soon:].any()


# --- time stamps that mean "no time"

NO_TIMES_US = (0, -1, -(2**63))


@pytest.mark.parametrize("no_time_us", NO_TIMES_US)
def test_a_frame_without_a_time_does_not_disturb_the_clock(no_time_us: int) -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    stamps = frames.timestamps_us.copy()
    without = np.arange(len(frames)) % 7 == 3
    stamps[without] = no_time_us
    observed = observe(ServerClock(), frames.with_timestamps(stamps))
    assert not observed.restarted.any()
    assert not observed.has_clock[without].any()
    assert (observed.captures_utime == frames.arrivals_utime)[without].all()
    assert observed.has_clock[2 * SECOND :][~without[2 * SECOND :]].all()
    # After a frame that has the time of its arrival, capture times may not go back.
    assert (np.diff(observed.captures_utime) >= 0).all()
    before_next = ~without & ~np.roll(without, 1)
    assert percentile_95_us(observed.errors_us[LEARNED:][before_next[LEARNED:]]) < 10_000


@pytest.mark.parametrize("no_time_us", NO_TIMES_US)
@pytest.mark.parametrize(
    ("first", "end", "clock_from", "right_from"),
    [
        pytest.param(0, 10 * SECOND, 12 * SECOND, 13 * SECOND, id="only later"),
        pytest.param(LEARNED, 35 * SECOND, 35 * SECOND, 35 * SECOND + 10, id="the same clock after a while"),
    ],
)
def test_a_server_that_has_no_time_for_a_while_has_a_clock_after_it(
    no_time_us: int, first: int, end: int, clock_from: int, right_from: int
) -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=50)
    stamps = frames.timestamps_us.copy()
    stamps[first:end] = no_time_us
    observed = observe(ServerClock(), frames.with_timestamps(stamps))
    assert not observed.restarted.any()
    assert not observed.has_clock[first:end].any()
    assert observed.has_clock[clock_from:].all()
    assert percentile_95_us(observed.errors_us[right_from:]) < (200 if first else 500)


def test_after_a_restart_0_is_a_time() -> None:
    clock = learned(simulate(seconds=40, rate_hz=RATE_HZ))
    assert clock.observe(0, 0, EPOCH_UTIME + 60_000_000) == (EPOCH_UTIME + 60_000_000, 0.0, True)
    assert clock.has_clock


# --- without jitter, to the frame


class ExactFrames:
    """Frames 5 ms apart, shown to a clock that has seen ten seconds of them; ``late_us`` delays the next."""

    def __init__(self) -> None:
        self.clock = ServerClock()
        self.late_us = 0
        self._number = 0
        for _ in range(10 * SECOND):
            self.lag_s()

    def lag_s(self, timestamp_us: int | None = None) -> float:
        """Return the lag of the next frame, which may have another time stamp than its own."""
        self._number += 1
        captured_us = 5_000 * self._number
        stamp_us = captured_us if timestamp_us is None else timestamp_us
        _, lag_s, _ = self.clock.observe(stamp_us, self._number, EPOCH_UTIME + captured_us + self.late_us)
        return lag_s


def test_a_shift_that_lasts_is_believed_after_two_seconds() -> None:
    frames = ExactFrames()
    frames.late_us = 1_000_000
    lags_s = [frames.lag_s() for _ in range(2 * SECOND)]
    assert min(lags_s) == max(lags_s) == pytest.approx(1.0)
    assert frames.lag_s() == 0.0


def test_a_time_stamp_may_be_repeated_for_half_a_second() -> None:
    frames = ExactFrames()
    frozen_us = 10_000_000
    for _ in range(SECOND // 2):
        frames.lag_s(frozen_us)
    assert frames.clock.has_clock is True
    frames.lag_s(frozen_us)
    assert [frames.clock.has_clock] == [False]


def wrapped(time_us: int) -> int:
    """Return a time as a server shows it that counts µs in 32 bits."""
    return time_us % WRAP_US


def test_a_second_wrap_around_continues_the_time_like_the_first() -> None:
    clock = ServerClock()
    times_us = range(0, 2 * WRAP_US + 60_000_000, 1_000_000)
    assert len(times_us) > 8_000
    observed = [
        clock.observe(wrapped(time_us), number, EPOCH_UTIME + time_us)
        for number, time_us in enumerate(times_us)
    ]
    assert not any(restarted for _, _, restarted in observed)
    assert observed[-1] == (EPOCH_UTIME + times_us[-1], 0.0, False)
    assert clock.offset_us == EPOCH_UTIME + 2 * WRAP_US


def test_a_wrap_around_during_a_pause_is_no_restart() -> None:
    clock = ServerClock()
    before_us = range(WRAP_US - 70_000_000, WRAP_US - 60_000_000, 5_000)
    observed = [
        clock.observe(wrapped(time_us), number, EPOCH_UTIME + time_us)
        for number, time_us in enumerate([*before_us, WRAP_US + 60_000_000])
    ]
    assert observed[-1] == (EPOCH_UTIME + WRAP_US + 60_000_000, 0.0, False)
    assert clock.has_clock
