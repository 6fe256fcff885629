"""New connections: to the same server, and to one that has restarted with any time stamps."""

import numpy as np
import pytest

from gateway.session.clock import ServerClock
from tests.support.clock_simulation import Frames, Observed, observe, percentile_95_us, simulate

RATE_HZ = 200
SECOND = RATE_HZ  # frames
OUTAGE_S = 40
WRAP_US = 2**32


def reconnected(
    clock: ServerClock, frames: Frames, ahead_us: int = 0, outage_s: float = OUTAGE_S, number: int = 100_000
) -> Observed:
    """Observe the last second of ``frames`` on a new connection, after an outage, with other time stamps.

    The time stamps are ``ahead_us`` ahead of those that the former server would have sent.
    """
    clock.begin_connection()
    later = frames.part(-SECOND).with_host_set(round(outage_s * 1e6))
    stamps_us = frames.timestamps_us[-SECOND:] + round(outage_s * 1e6) + ahead_us
    return observe(clock, later.with_timestamps(stamps_us), number)


def connected(seed: int = 0, seconds: float = 20) -> tuple[ServerClock, Frames]:
    """Return a clock that has learned from a connection, and frames that continue it."""
    frames = simulate(seconds=seconds, rate_hz=RATE_HZ, seed=seed)
    clock = ServerClock()
    observe(clock, frames.part(0, -SECOND))
    return clock, frames


@pytest.mark.parametrize("ahead_s", [-39.5, -37.294, -10, -1, -0.3, -0.05, 0.05, 0.3, 10, 3600])
def test_a_restarted_server_has_the_right_time_from_its_first_frame(ahead_s: float) -> None:
    """Its time stamps go forward, but by another time than the outage took."""
    clock, frames = connected()
    observed = reconnected(clock, frames, round(ahead_s * 1e6))
    delays_us = frames.arrivals_utime[-SECOND:] - frames.captured_utime[-SECOND:]
    assert observed.has_clock.all()
    assert observed.errors_us.min() > -2_000
    assert (observed.errors_us <= delays_us).all()
    assert percentile_95_us(observed.errors_us[SECOND // 2 :]) < 300
    assert observed.lags_s.max() < 0.1


@pytest.mark.parametrize(
    ("ahead_s", "number", "is_restart"),
    [
        (0, 100_000, False),
        (0.3, 100_000, False),  # a delay, or a clock that was set
        (-0.3, 100_000, False),
        (-37, 100_000, True),
        (37, 100_000, True),
        (-45, 100_000, True),  # the time stamps go back
        (0, 0, False),  # only the numbers do: some servers number each connection
    ],
)
def test_a_restart_shows_in_the_first_frame_of_a_connection(
    ahead_s: float, number: int, *, is_restart: bool
) -> None:
    """A jump of more than a second is a restart, and so are time stamps that go back; a delay is none."""
    clock, frames = connected()
    observed = reconnected(clock, frames, round(ahead_s * 1e6), number=number)
    assert observed.restarted.tolist() == [is_restart] + (SECOND - 1) * [False]


@pytest.mark.parametrize("outage_s", [0.1, OUTAGE_S, 3600])
def test_the_former_clock_continues_if_the_new_time_stamps_prove_it(outage_s: float) -> None:
    """What was learned in seconds of samples is not thrown away for an outage of the network."""
    clock, frames = connected()
    num_samples = clock.samples
    observed = reconnected(clock, frames, outage_s=outage_s)
    assert clock.samples >= num_samples > 30
    assert percentile_95_us(observed.errors_us[SECOND // 2 :]) < 200


def test_a_late_first_frame_does_not_hide_that_the_former_clock_holds() -> None:
    """The first frames come 0.3 s late; the first one in time proves the former clock."""
    clock, frames = connected()
    num_samples = clock.samples
    late = frames.with_delays(np.where(np.arange(len(frames)) < len(frames) - SECOND // 2, 300_000.0, 0.0))
    observed = reconnected(clock, late)
    assert clock.samples >= num_samples
    assert (observed.errors_us <= late.arrivals_utime[-SECOND:] - late.captured_utime[-SECOND:]).all()
    assert np.diff(observed.captures_utime).min() >= 0


def late_from(frames: Frames, first: int, end: int | None, delay_us: float) -> Frames:
    """Return the frames, with those from index ``first`` to before ``end`` late."""
    delays_us = np.zeros(len(frames))
    delays_us[first:end] = delay_us
    return frames.with_delays(delays_us)


def test_an_early_frame_disproves_the_former_clock_for_good() -> None:
    """Later frames that happen to fit the former clock are late ones."""
    clock, frames = connected()
    late = late_from(frames, -SECOND + SECOND // 4, None, 300_000)
    observed = reconnected(clock, late, 300_000)
    assert clock.samples < 5
    assert observed.lags_s[-1] > 0.25


def test_the_former_clock_is_forgotten_after_half_a_minute() -> None:
    """Until then, congestion may hide that it holds; what fits it later does so by chance."""
    frames = simulate(seconds=70, rate_hz=RATE_HZ)
    clock = ServerClock()
    observe(clock, frames.part(0, 20 * SECOND))
    congested = late_from(frames, 0, 55 * SECOND, 100_000).part(21 * SECOND, 56 * SECOND)
    clock.begin_connection()
    observe(clock, congested, 100_000)
    assert 0 < clock.samples < 5


def test_the_former_drift_continues_with_the_former_clock() -> None:
    """Congestion that grows after a new connection looks like another drift."""
    frames = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=100)
    clock = ServerClock()
    observe(clock, frames.part(0, 20 * SECOND))
    growing_us = np.where(
        np.arange(len(frames)) < 36 * SECOND, 100_000 + 300e-6 * 5_000.0 * np.arange(len(frames)), 0
    )
    congested = frames.with_delays(growing_us).part(21 * SECOND, 37 * SECOND)
    clock.begin_connection()
    observe(clock, congested.part(0, 14 * SECOND), 100_000)
    assert clock.drift_ppm > 200
    observe(clock, congested.part(14 * SECOND), 200_000)
    assert clock.drift_ppm == pytest.approx(100, abs=10)


def test_the_clock_of_a_restarted_server_continues_in_the_connection_after_it() -> None:
    """The clock before the restart is of no use any more."""
    clock, frames = connected()
    clock.begin_connection()
    restarted = frames.with_timestamps(frames.timestamps_us + OUTAGE_S * 1_000_000 - 5_000_000)
    observe(clock, restarted.part(0, 5 * SECOND).with_host_set(OUTAGE_S * 1_000_000), 100_000)
    num_samples = clock.samples
    clock.begin_connection()
    observe(clock, restarted.part(10 * SECOND, 11 * SECOND).with_host_set(OUTAGE_S * 1_000_000), 200_000)
    assert clock.samples >= num_samples > 5


def test_a_connection_that_ends_at_once_does_not_end_the_former_clock() -> None:
    """Without a sample of its own, it leaves the clock of the connection before it to the next one."""
    clock, frames = connected()
    num_samples = clock.samples
    clock.begin_connection()
    late = frames.part(-SECOND, -SECOND + 1).with_host_set(500_000)
    observe(clock, late, 100_000)
    reconnected(clock, frames)
    assert clock.has_clock
    assert clock.samples >= num_samples


def test_a_clock_that_is_still_being_learned_begins_anew() -> None:
    """Samples of two time bases would not make a clock for half a minute."""
    clock = ServerClock()
    frames = simulate(seconds=20, rate_hz=RATE_HZ)
    observe(clock, frames.part(0, SECOND))
    clock.begin_connection()
    observed = observe(
        clock,
        frames.part(0, 2 * SECOND)
        .with_host_set(60_000_000)
        .with_timestamps(frames.timestamps_us[: 2 * SECOND] + 30_000_000),
        1000,
    )
    assert observed.has_clock[-1]
    assert percentile_95_us(observed.errors_us[-10:]) < 2_000


def test_time_stamps_may_wrap_around_between_connections() -> None:
    """The former clock continues, as within a connection."""
    frames = simulate(seconds=20, rate_hz=RATE_HZ, start_us=WRAP_US - 30_000_000)
    clock = ServerClock()
    observe(clock, frames)
    num_samples = clock.samples
    clock.begin_connection()
    later = frames.part(-SECOND).with_host_set(OUTAGE_S * 1_000_000)
    observed = observe(
        clock, later.with_timestamps((later.timestamps_us + OUTAGE_S * 1_000_000) % WRAP_US), 100_000
    )
    assert not observed.restarted.any()
    assert clock.samples >= num_samples
    assert percentile_95_us(observed.errors_us[SECOND // 2 :]) < 200
