"""Simulated frames of a server whose clock is known exactly, with network delays. No test waits for them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from gateway.session.clock import ServerClock

EPOCH_UTIME: Final = 1_700_000_000_000_000
LEAST_DELAY_US: Final = 300

Times = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.float64]


def whole_us(times_us: npt.NDArray[np.floating[Any]]) -> Times:
    """Return the times rounded to µs."""
    return np.round(times_us).astype(np.int64)


@dataclass(frozen=True)
class Frames:
    """Frames in the order of arrival; the arrays have the shape (frames,) and are in µs.

    ``captured_utime`` includes the network's least delay, which a receiver cannot measure.
    """

    timestamps_us: Times
    arrivals_utime: Times
    captured_utime: Times

    def __len__(self) -> int:
        return len(self.timestamps_us)

    def __add__(self, other: Self) -> "Frames":
        return Frames(
            np.concatenate([self.timestamps_us, other.timestamps_us]),
            np.concatenate([self.arrivals_utime, other.arrivals_utime]),
            np.concatenate([self.captured_utime, other.captured_utime]),
        )

    def part(self, first: int, end: int | None = None) -> "Frames":
        """Return the frames from index ``first`` to before ``end``."""
        indices = slice(first, end)
        return Frames(self.timestamps_us[indices], self.arrivals_utime[indices], self.captured_utime[indices])

    def with_timestamps(self, timestamps_us: Times) -> "Frames":
        """Return the same frames with other time stamps."""
        return replace(self, timestamps_us=timestamps_us)

    def with_delays(self, delays_us: npt.NDArray[np.floating[Any]]) -> "Frames":
        """Return the same frames with these additional delays; no frame overtakes an earlier one."""
        arrivals = self.arrivals_utime + whole_us(delays_us)
        return replace(self, arrivals_utime=np.maximum.accumulate(arrivals))

    def with_host_set(self, by_us: int) -> "Frames":
        """Return the same frames as seen by a host whose clock was set forward by ``by_us``."""
        return Frames(self.timestamps_us, self.arrivals_utime + by_us, self.captured_utime + by_us)


def simulate(
    *,
    seconds: float,
    rate_hz: float,
    seed: int = 0,
    drift_ppm: float | Callable[[Numbers], Numbers] = 0.0,
    jitter_us: float = 5_000,
    outliers: float = 0.0,
    start_us: int = 5_000_000,
) -> Frames:
    """Return the frames of a server that captures at ``rate_hz`` for ``seconds`` of host time.

    The host's clock is faster than the server's by ``drift_ppm``, which may be a function of the host time in
    s. Delays are exponential with the mean ``jitter_us``; a share of ``outliers`` has 200 ms more. TCP keeps
    the order, so frames that follow a late frame are late, too. The server's clock starts at ``start_us``.
    """
    random = np.random.default_rng(seed)
    host_s = np.arange(round(seconds * rate_hz)) / rate_hz
    drift = np.asarray(drift_ppm(host_s) if callable(drift_ppm) else drift_ppm) * 1e-6
    server_s = np.cumsum(np.diff(host_s, prepend=0.0) / (1 + drift))
    delays_us = random.exponential(1.0, len(host_s)) * jitter_us
    delays_us += 200_000 * (random.random(len(host_s)) < outliers)
    captured = EPOCH_UTIME + LEAST_DELAY_US + whole_us(host_s * 1e6)
    stamps = start_us + whole_us(server_s * 1e6)
    return Frames(stamps, captured, captured).with_delays(delays_us)


def delayed(frames: Frames, rate_hz: float, seconds: Sequence[float], delays_s: Sequence[float]) -> Frames:
    """Return the frames with delays interpolated between the points (``seconds``, ``delays_s``)."""
    return frames.with_delays(np.interp(np.arange(len(frames)) / rate_hz, seconds, delays_s) * 1e6)


@dataclass(frozen=True)
class Observed:
    """The readings of a clock at each frame; the arrays have the shape (frames,)."""

    captures_utime: Times
    lags_s: Numbers
    restarted: npt.NDArray[np.bool_]
    has_clock: npt.NDArray[np.bool_]
    uncertainties_us: Numbers
    errors_us: Times


def observe(clock: ServerClock, frames: Frames, first_frame_number: int = 0) -> Observed:
    """Return the readings of ``clock`` for the frames, which are numbered from ``first_frame_number``."""
    readings = []
    pairs = zip(frames.timestamps_us.tolist(), frames.arrivals_utime.tolist(), strict=True)
    for number, (timestamp_us, arrival_utime) in enumerate(pairs, first_frame_number):
        readings.append(
            (*clock.observe(timestamp_us, number, arrival_utime), clock.has_clock, clock.uncertainty_us)
        )
    captures, lags, restarted, has_clock, uncertainties = zip(*readings, strict=True)
    captures_utime = np.array(captures, np.int64)
    return Observed(
        captures_utime,
        np.array(lags),
        np.array(restarted),
        np.array(has_clock),
        np.array(uncertainties),
        captures_utime - frames.captured_utime,
    )


def learned(frames: Frames) -> ServerClock:
    """Return a clock that has seen the frames."""
    clock = ServerClock()
    observe(clock, frames)
    return clock


def percentile_95_us(errors_us: Times) -> float:
    """Return the 95th percentile of the errors' absolute values."""
    return float(np.percentile(np.abs(errors_us), 95))
