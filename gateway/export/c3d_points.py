"""The points of a C3D file: positions, and residuals in steps."""

from collections.abc import Iterable
from typing import Final

import numpy as np

from gateway.takes.component_rows import Array

_MAX_STEPS: Final = 127
_BOTH_BYTES: Final = 257
_MISSING: Final = (0.0, 0.0, 0.0, -1.0)


def encode_points(markers: Array, step: float) -> Array:
    """Return the words of points from markers, both of shape (frames, markers, 4).

    A point that is missing is 0, 0, 0, -1. The fourth word of a visible one has two bytes. In c3d.org's guide
    and in NDI's files, the low byte is the residual in steps, and the high byte says which cameras saw the
    marker; ezc3d reads them the other way round. The protocol says nothing about cameras, so both bytes have
    the residual.
    """
    words = markers.copy()
    steps = np.clip(np.round(np.nan_to_num(markers[..., 3]).astype(np.float64) / step), 0, _MAX_STEPS)
    words[..., 3] = steps * _BOTH_BYTES
    words[np.isnan(markers[..., :3]).any(axis=2)] = _MISSING
    return words


def residual_step(blocks: Iterable[Array]) -> float:
    """Return the step of residuals, in the unit of the points, for markers of shape (frames, markers, 4).

    A residual has 7 bits. The step is the smallest residual if all are multiples of it, and thus exact.
    """
    different: Array = np.empty(0, np.float32)
    is_exact = True
    for markers in blocks:
        visible = ~np.isnan(markers[..., :3]).any(axis=2)
        residuals = markers[..., 3][visible]
        different = np.union1d(different, residuals[np.isfinite(residuals) & (residuals > 0)])
        if len(different) > _MAX_STEPS:
            different, is_exact = different[[0, -1]], False
    if not len(different):
        return 1.0
    multiples = different.astype(np.float64) / different[0]  # a damaged one may be 1e-40
    is_exact = is_exact and multiples[-1] <= _MAX_STEPS + 0.5
    is_exact = is_exact and bool(np.allclose(multiples, np.round(multiples), rtol=1e-5))
    return float(different[0] if is_exact else different[-1] / np.float32(_MAX_STEPS))
