"""Servers that restart with any time stamps, against the true times of capture."""

from typing import NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gateway.session.clock import ServerClock
from tests.support.clock_simulation import Frames, observe, simulate

TOLERANCE_US = 3_000
"""What docs/explanation/clocks.md promises after a new connection, beside the uncertainty; 1 ms is drift."""

MIN_US = -(2**40)


class Connection(NamedTuple):
    """A connection, the outage before it, and how the server's time stamps continue."""

    seconds: float
    outage_s: float
    jump_us: int | None
    """From the last time stamp of the connection before to the first one; None if the server ran on."""
    is_near: bool
    """Whether the jump counts from the time stamp that the server would have sent without a restart."""
    first_number: int | None
    """Of the frames; None to continue."""
    load_s: float
    """Waves of delays, as under load, are so high."""
    jitter_us: float


jumps = (
    st.none()
    | st.integers(-3_600_000_000, 3_600_000_000)
    | st.sampled_from([0, 1, -1])
    | st.integers(0, 60_000_000)
)
connections = st.builds(
    Connection,
    seconds=st.floats(0.1, 6) | st.floats(0.1, 12),
    outage_s=st.floats(0.05, 60),
    jump_us=jumps | st.integers(-400_000, 400_000),
    is_near=st.booleans(),
    first_number=st.none() | st.integers(0, 10_000),
    load_s=st.just(0.0) | st.floats(0.0, 2.0),
    jitter_us=st.sampled_from([0, 500, 5_000]),
)


def schedule(connections: list[Connection], rate_hz: float, drift_ppm: float, seed: int) -> list[Frames]:
    """Return the frames of each connection, with the true times of capture."""
    parts: list[Frames] = []
    host_us, stamp_us = 0, 1_000_000_000
    for index, each in enumerate(connections):
        frames = simulate(
            seconds=each.seconds + 2 / rate_hz,
            rate_hz=rate_hz,
            seed=seed + index,
            drift_ppm=drift_ppm,
            jitter_us=each.jitter_us,
            start_us=0,
        )
        waves_s = each.load_s * np.abs(np.sin(np.arange(len(frames)) / rate_hz + seed))
        frames = frames.with_delays(waves_s * 1e6)
        outage_us = round(each.outage_s * 1e6) + (
            int(parts[-1].arrivals_utime[-1]) - int(parts[-1].captured_utime[-1]) if parts else 0
        )
        host_us += outage_us
        ran_on_us = round(outage_us / (1 + drift_ppm * 1e-6))
        if each.jump_us is None:
            stamp_us += ran_on_us
        else:
            stamp_us = max(stamp_us + each.jump_us + (ran_on_us if each.is_near else 0), MIN_US)
        parts.append(frames.with_timestamps(frames.timestamps_us + stamp_us).with_host_set(host_us))
        host_us += int(frames.captured_utime[-1] - frames.captured_utime[0])
        stamp_us = int(parts[-1].timestamps_us[-1])
    return parts


@given(
    st.lists(connections, min_size=2, max_size=4),
    st.lists(st.sampled_from([30.0, 100.0, 300.0]), min_size=1, max_size=3, unique=True),
    st.floats(-100, 100),
    st.integers(0, 2**20),
)
def test_capture_times_are_right_from_the_first_frame_of_each_connection(
    connections: list[Connection], rates_hz: list[float], drift_ppm: float, seed: int
) -> None:
    """They are never later than the arrival, and never earlier than the truth by more than documented."""
    for rate_hz in rates_hz:
        clock = ServerClock()
        number = 0
        uncertainty_us = 0.0
        for each, frames in zip(connections, schedule(connections, rate_hz, drift_ppm, seed), strict=True):
            number = number if each.first_number is None else each.first_number
            clock.begin_connection()
            observed = observe(clock, frames, number)
            number += len(frames)
            known_us = observed.uncertainties_us[np.isfinite(observed.uncertainties_us)]
            uncertainty_us = max(uncertainty_us, *known_us.tolist(), 0.0)
            assert (observed.captures_utime <= frames.arrivals_utime).all()
            assert observed.errors_us.min() >= -TOLERANCE_US - uncertainty_us
            delays_s = (frames.arrivals_utime - frames.captured_utime) / 1e6
            assert (observed.lags_s - delays_s).max() <= (TOLERANCE_US + uncertainty_us) / 1e6
            assert not observed.restarted[1:].any()
