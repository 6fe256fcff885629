"""How long messages take from stage to stage."""

from typing import Final, NamedTuple

import numpy as np

from gateway.takes.component_rows import Array

_NUM_SAMPLES: Final = 2000


class Percentiles(NamedTuple):
    """Percentiles of a latency, in milliseconds."""

    p50_ms: float
    p99_ms: float


class Latency:
    """The latencies of the newest messages, at most 2000, by stage.

    Latencies to this computer are on two clocks if the gateway runs on another computer, and then they are
    only as exact as these clocks agree. They may be negative.
    """

    def __init__(self) -> None:
        self._samples = np.zeros((_NUM_SAMPLES, 2))  # ms from capture to the gateway, and from there to here
        self._num_added = 0

    def add(self, capture_utime: Array, utime: Array, arrived_utime: Array) -> None:
        """Take the times of messages, each with the shape (messages,), in µs since the Unix epoch."""
        times = np.stack([capture_utime, utime, arrived_utime]).astype(np.float64)[:, -_NUM_SAMPLES:]
        places = (self._num_added + np.arange(times.shape[1])) % _NUM_SAMPLES
        self._samples[places] = np.diff(times, axis=0).T / 1000
        self._num_added += times.shape[1]

    @property
    def to_gateway(self) -> Percentiles | None:
        """From the capture to the arrival at the gateway; None before the first message."""
        return self._percentiles(0)

    @property
    def to_here(self) -> Percentiles | None:
        """From the arrival at the gateway to the arrival at this program; None before the first message."""
        return self._percentiles(1)

    def _percentiles(self, stage: int) -> Percentiles | None:
        if not self._num_added:
            return None
        p50, p99 = np.percentile(self._samples[: self._num_added, stage], (50, 99))
        return Percentiles(float(p50), float(p99))
