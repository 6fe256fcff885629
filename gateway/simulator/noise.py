"""Measurement noise that depends only on the sample's number."""

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from gateway.rtc3d_server.scene import SampleNumbers

Floats = npt.NDArray[np.floating[Any]]

_TABLE_SIZE: Final = 2**16
_STRIDE: Final = 7919  # odd, so that a column reads the whole table before it repeats


class Noise:
    """Normally distributed noise of standard deviation 1, always the same for the same sample number.

    All ``width`` columns read the same table of random numbers, each from its own position. This is much
    cheaper than a generator per sample, and repeats only after 65536 samples.
    """

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._table = rng.standard_normal(_TABLE_SIZE, dtype=np.float32)
        self._columns = rng.integers(0, _TABLE_SIZE, width)

    def __call__(self, samples: SampleNumbers) -> Floats:
        """Return the noise of each sample, shape (len(samples), width)."""
        positions: npt.NDArray[np.int64] = (samples[:, None] * _STRIDE + self._columns) & (_TABLE_SIZE - 1)
        return self._table.take(positions)
