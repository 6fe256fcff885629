from itertools import combinations, pairwise

from hypothesis import example, given
from hypothesis import strategies as st

from gateway.session.clock import Sample, ServerClock, envelope_slope
from tests.support.clock_simulation import EPOCH_UTIME, observe, percentile_95_us, simulate

EXTREMES_US = (0, -1, 1, -(2**63), 2**63 - 1, 2**32 - 1, 2**32, -(2**32))
timestamps_us = st.integers(-(2**63), 2**63 - 1) | st.sampled_from(EXTREMES_US)
arrivals_utime = st.integers(EPOCH_UTIME, EPOCH_UTIME + 10**8)
frame_numbers = st.integers(-(2**31), 2**31 - 1)

any_frames = st.lists(st.tuples(timestamps_us | st.integers(0, 10**8), frame_numbers, arrivals_utime))
"""Time stamps of any size, including realistic ones, in any order."""

one_time_base = st.lists(st.tuples(st.integers(1, 10**6), st.integers(0, 10**6)), min_size=2).map(
    lambda steps: [
        (
            sum(step[0] for step in steps[: index + 1]),
            EPOCH_UTIME + sum(step[1] for step in steps[: index + 1]),
        )
        for index in range(len(steps))
    ]
)
"""Time stamps that grow and arrival times that do not decrease, at any rates."""


@given(any_frames)
def test_no_frame_is_captured_after_its_arrival_whatever_its_time_stamp(
    frames: list[tuple[int, int, int]],
) -> None:
    clock = ServerClock()
    for timestamp_us, frame_number, arrival_utime in frames:
        capture_utime, lag_s, _ = clock.observe(timestamp_us, frame_number, arrival_utime)
        assert capture_utime <= arrival_utime
        assert lag_s >= 0
        if not clock.has_clock:
            assert (capture_utime, lag_s) == (arrival_utime, 0)


@given(st.integers(0, 2**20), one_time_base)
def test_capture_times_do_not_decrease_while_time_stamps_grow(
    seed: int, steps: list[tuple[int, int]]
) -> None:
    learned_from = simulate(seconds=4, rate_hz=30, seed=seed)
    clock = ServerClock()
    captures = list(observe(clock, learned_from).captures_utime)
    last_us, last_utime = int(learned_from.timestamps_us[-1]), int(learned_from.arrivals_utime[-1])
    for timestamp_us, arrival_utime in steps:
        capture_utime, _, restarted = clock.observe(
            last_us + timestamp_us, 1000, last_utime + arrival_utime - EPOCH_UTIME
        )
        assert not restarted
        captures.append(capture_utime)
    assert all(before <= after for before, after in pairwise(captures))


@given(
    seed=st.integers(0, 2**20),
    drift_ppm=st.floats(-450, 450),
    rate_hz=st.floats(20, 400),
    start_us=st.integers(-(2**40), 2**40),
)
def test_the_drift_of_any_crystal_is_learned(
    seed: int, drift_ppm: float, rate_hz: float, start_us: int
) -> None:
    frames = simulate(
        seconds=12, rate_hz=rate_hz, seed=seed, drift_ppm=drift_ppm, jitter_us=1_000, start_us=start_us
    )
    observed = observe(ServerClock(), frames)
    assert not observed.restarted.any()
    assert percentile_95_us(observed.errors_us[round(10 * rate_hz) :]) < 500


@given(st.integers(0, 2**20), st.integers(0, 2**60), st.integers(0, 10**15))
def test_the_epochs_of_the_clocks_make_no_difference(seed: int, stamps_by_us: int, host_by_us: int) -> None:
    frames = simulate(seconds=8, rate_hz=60, seed=seed, drift_ppm=100)
    moved = frames.with_timestamps(frames.timestamps_us + stamps_by_us).with_host_set(host_by_us)
    captures = observe(ServerClock(), frames).captures_utime
    assert (observe(ServerClock(), moved).captures_utime == captures + host_by_us).all()


@given(
    seconds=st.floats(0.1, 5),
    back_us=st.integers(1, 2**31) | st.integers(2**32, 2**62),
    frame_number=frame_numbers,
    away_us=st.integers(0, 10**7),
)
@example(seconds=1, back_us=2**32, frame_number=1000, away_us=0)
def test_a_time_stamp_that_goes_back_is_a_restart(
    seconds: float, back_us: int, frame_number: int, away_us: int
) -> None:
    frames = simulate(seconds=seconds, rate_hz=60)
    clock = ServerClock()
    observe(clock, frames)
    arrival_utime = int(frames.arrivals_utime[-1]) + away_us
    reading = clock.observe(int(frames.timestamps_us[-1]) - back_us, frame_number, arrival_utime)
    assert reading == (arrival_utime, 0, True)


@given(
    st.lists(
        st.tuples(st.integers(0, 10**9), st.integers(0, 10**6)),
        min_size=2,
        max_size=20,
        unique_by=lambda point: point[0],
    ).map(sorted)
)
def test_no_line_below_all_samples_is_nearer(points: list[tuple[int, int]]) -> None:
    samples = [Sample(*point) for point in points]

    def distance(slope: float) -> float:
        """Return the sum of distances to the highest line of this slope below all samples."""
        above = [sample.offset_us - slope * sample.timestamp_us for sample in samples]
        return sum(above) - len(above) * min(above)

    slopes = [
        (b.offset_us - a.offset_us) / (b.timestamp_us - a.timestamp_us) for a, b in combinations(samples, 2)
    ]
    nearest = min(distance(slope) for slope in slopes)
    assert distance(envelope_slope(samples)) <= nearest + 1e-6 * max(1, nearest)
