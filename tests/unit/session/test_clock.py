import math
from collections.abc import Sequence

import numpy as np
import pytest

from gateway.session.clock import Sample, ServerClock, envelope_slope
from tests.support.clock_simulation import (
    EPOCH_UTIME,
    Frames,
    Numbers,
    delayed,
    learned,
    observe,
    percentile_95_us,
    simulate,
)

RATE_HZ = 200
SECOND = RATE_HZ  # frames
LEARNED = 30 * SECOND


def samples(*points: tuple[int, int]) -> list[Sample]:
    return [Sample(*point) for point in points]


# --- accuracy


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("drift_ppm", [100, -100])
def test_after_30_s_the_capture_time_is_within_half_a_millisecond(drift_ppm: float, seed: int) -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ, drift_ppm=drift_ppm, seed=seed)
    clock = ServerClock()
    observed = observe(clock, frames)
    assert percentile_95_us(observed.errors_us[LEARNED:]) < 100  # five times better than required
    assert clock.drift_ppm == pytest.approx(drift_ppm, abs=3)
    assert observed.has_clock[LEARNED:].all()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("rate_hz", "jitter_us", "outliers", "within_us"),
    [
        (30, 5_000, 0.0, 200),
        (RATE_HZ, 5_000, 0.02, 200),
        (RATE_HZ, 0, 0.0, 2),
        (1000, 1_000, 0.0, 50),
        # Nearly every frame waits behind another: one in thousands shows the least delay.
        (1000, 5_000, 0.0, 1_000),
    ],
)
def test_it_is_accurate_at_other_rates_and_on_worse_networks(
    rate_hz: float, jitter_us: float, outliers: float, within_us: float, seed: int
) -> None:
    frames = simulate(
        seconds=45, rate_hz=rate_hz, drift_ppm=100, jitter_us=jitter_us, outliers=outliers, seed=seed
    )
    errors_us = observe(ServerClock(), frames).errors_us[int(30 * rate_hz) :]
    assert percentile_95_us(errors_us) < within_us


def test_a_changing_drift_is_followed_for_ten_minutes() -> None:
    def warming_up(host_s: Numbers) -> Numbers:
        return np.asarray(100 * np.sin(2 * np.pi * host_s / 600))

    frames = simulate(seconds=600, rate_hz=RATE_HZ, drift_ppm=warming_up)
    errors_us = observe(ServerClock(), frames).errors_us
    assert max(percentile_95_us(part) for part in np.split(errors_us[LEARNED:], 19)) < 500


@pytest.mark.parametrize("jitter_us", [0, 5_000])
def test_errors_stay_within_the_uncertainty(jitter_us: float) -> None:
    frames = simulate(seconds=60, rate_hz=RATE_HZ, drift_ppm=100, jitter_us=jitter_us)
    observed = observe(ServerClock(), frames)
    within = np.abs(observed.errors_us) <= observed.uncertainties_us
    assert within[LEARNED:].mean() > 0.95
    assert observed.uncertainties_us[LEARNED:].max() < 200


def test_the_uncertainty_is_the_scatter_of_the_samples_that_the_line_does_not_touch() -> None:
    clock = ServerClock()
    for index, delay_us in enumerate([0, 300, 0, 0]):
        clock.observe(index * 600_000, index, EPOCH_UTIME + index * 600_000 + delay_us)
    assert (clock.samples, clock.uncertainty_us, clock.offset_us) == (3, 300, EPOCH_UTIME)


def test_lag_is_the_delay_beyond_the_least_delay() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    lags_us = observe(ServerClock(), frames).lags_s[LEARNED:] * 1e6
    true_us = (frames.arrivals_utime - frames.captured_utime)[LEARNED:]
    assert np.abs(lags_us - true_us).max() < 100


# --- the first frames


def test_there_is_no_clock_at_the_first_frame() -> None:
    clock = ServerClock()
    reading = clock.observe(123, 7, EPOCH_UTIME)
    assert reading == (EPOCH_UTIME, 0.0, False)
    assert (clock.has_clock, clock.offset_us, clock.drift_ppm, clock.samples) == (False, 0, 0.0, 0)
    assert clock.uncertainty_us == math.inf


def test_there_is_a_clock_after_one_and_a_half_seconds() -> None:
    frames = simulate(seconds=2, rate_hz=RATE_HZ)
    observed = observe(ServerClock(), frames)
    elapsed_s = (frames.arrivals_utime - frames.arrivals_utime[0]) / 1e6
    assert 1.5 <= elapsed_s[observed.has_clock.argmax()] < 1.6
    assert observed.has_clock[-1]


def test_the_offset_converts_a_time_stamp_to_host_time() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=100)
    clock = learned(frames)
    captured_utime = int(frames.timestamps_us[-1]) + clock.offset_us
    assert captured_utime == pytest.approx(int(frames.captured_utime[-1]), abs=100)


def test_samples_are_kept_for_half_a_minute() -> None:
    assert learned(simulate(seconds=5.1, rate_hz=RATE_HZ)).samples == 10
    assert learned(simulate(seconds=60, rate_hz=RATE_HZ)).samples == 60


def test_frames_rarer_than_the_windows_make_a_clock_too() -> None:
    frames = simulate(seconds=120, rate_hz=1, drift_ppm=50)
    observed = observe(ServerClock(), frames)
    assert observed.has_clock[-1]
    assert percentile_95_us(observed.errors_us[60:]) < 3_000


@pytest.mark.parametrize("seed", range(20))
def test_capture_times_do_not_go_back_when_a_better_line_is_lower(seed: int) -> None:
    frames = simulate(seconds=20, rate_hz=1000, seed=seed)
    assert (np.diff(observe(ServerClock(), frames).captures_utime) >= 0).all()


# --- late frames


@pytest.mark.parametrize(
    ("seconds", "delays_s"),
    [
        pytest.param([29.996, 30, 30.004], [0, 1, 0], id="one late frame"),
        pytest.param([29.999, 30, 35], [0, 5, 0], id="a pause of the gateway"),
        pytest.param([30, 40, 45, 50], [0, 0.8, 0.8, 0], id="grows and clears"),
        pytest.param([30, 30.2, 50], [0, 0.8, 0], id="begins suddenly and clears slowly"),
        pytest.param([30, 55], [0, 0.02], id="grows by 0.8 ms/s"),
    ],
)
def test_lateness_is_lag_and_does_not_move_the_clock(
    seconds: Sequence[float], delays_s: Sequence[float]
) -> None:
    frames = delayed(simulate(seconds=60, rate_hz=RATE_HZ), RATE_HZ, seconds, delays_s)
    observed = observe(ServerClock(), frames)
    assert percentile_95_us(observed.errors_us[LEARNED : 55 * SECOND]) < 500
    true_s = (frames.arrivals_utime - frames.captured_utime) / 1e6
    assert observed.lags_s[LEARNED : 55 * SECOND] == pytest.approx(true_s[LEARNED : 55 * SECOND], abs=0.001)


def test_a_hiccup_every_three_seconds_does_not_move_the_clock() -> None:
    frames = simulate(seconds=90, rate_hz=RATE_HZ)
    index = np.arange(len(frames))
    hiccups_us = 300_000.0 * ((index >= LEARNED) & (index % (3 * SECOND) < 1.2 * SECOND))
    observed = observe(ServerClock(), frames.with_delays(hiccups_us))
    assert np.abs(observed.errors_us[LEARNED:]).max() < 500


def test_endless_congestion_becomes_the_networks_delay_after_half_a_minute() -> None:
    frames = simulate(seconds=90, rate_hz=RATE_HZ)
    waves_s = 0.5 + 0.2 * np.sin(np.arange(len(frames)) / RATE_HZ * 2 * np.pi / 5)
    waves_s[:LEARNED] = 0
    observed = observe(ServerClock(), frames.with_delays(waves_s * 1e6))
    assert observed.lags_s[LEARNED : 58 * SECOND].min() > 0.25
    assert observed.lags_s[65 * SECOND :].min() < 0.02


def test_a_lasting_delay_becomes_the_networks_delay_after_half_a_minute() -> None:
    frames = delayed(simulate(seconds=90, rate_hz=RATE_HZ), RATE_HZ, [30, 40], [0, 0.3])
    observed = observe(ServerClock(), frames)
    assert observed.lags_s[42 * SECOND : 58 * SECOND].min() > 0.29
    assert observed.lags_s[75 * SECOND :].max() < 0.1


def test_duplicate_frames_have_the_same_capture_time() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ)
    doubled = Frames(
        np.repeat(frames.timestamps_us, 2),
        np.repeat(frames.arrivals_utime, 2) + np.tile([0, 30], len(frames)),
        np.repeat(frames.captured_utime, 2),
    )
    observed = observe(ServerClock(), doubled)
    assert not observed.restarted.any()
    assert percentile_95_us(observed.errors_us[2 * LEARNED :]) < 100
    captures = observed.captures_utime[2 * LEARNED :].reshape(-1, 2)
    assert (captures[:, 0] == captures[:, 1]).all()


def test_coarse_time_stamps_make_a_clock() -> None:
    frames = simulate(seconds=40, rate_hz=RATE_HZ, drift_ppm=50)
    coarse = frames.with_timestamps(frames.timestamps_us // 20_000 * 20_000)
    observed = observe(ServerClock(), coarse)
    assert observed.has_clock[LEARNED:].all()
    assert np.abs(observed.errors_us[LEARNED:]).max() < 21_000


# --- the line


@pytest.mark.parametrize(
    ("points", "slope"),
    [
        (samples((0, 0), (10, 5)), 0.5),
        (samples((0, 5), (10, 0)), -0.5),
        (samples((0, 0), (5, 7), (10, 10)), 1.0),
        # The hull has two edges, and the second one spans the mean time stamp, 5.
        (samples((0, 4), (4, 0), (5, 9), (6, 9), (10, 3)), 0.5),
        # The first one spans the mean, 3.8.
        (samples((0, 6), (1, 9), (2, 9), (6, 0), (10, 4)), -1.0),
    ],
)
def test_the_line_is_the_nearest_one_below_all_samples(points: Sequence[Sample], slope: float) -> None:
    assert envelope_slope(points) == slope
