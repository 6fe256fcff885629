"""Rows of numbers as text, many at once.

Formatting each number by itself would take most of an hour for an hour of a gait laboratory. Here, numpy
computes the digits of whole blocks, which takes a tenth of the time.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from gateway.takes.files.component_rows import Array

_NUM_DIGITS: Final = 9
"""As many digits as any 32-bit float needs to be read back exactly."""

_MAX_EXPONENT: Final = 60
"""All 32-bit floats are between 1e-60 and 1e60. Smaller numbers are written as 0, larger ones as missing."""

_POWERS: Final = 10.0 ** np.arange(-_MAX_EXPONENT, _MAX_EXPONENT + _NUM_DIGITS)
_CELL_BYTES: Final = 16  # a tab, the sign, "1.23456789e-01"
_FIRST_DIGIT: Final = 2
_EXPONENT: Final = _CELL_BYTES - 4
_ZERO, _TAB, _MINUS, _PLUS, _POINT, _E = b"0\t-+.e"


def encode_rows(values: Array, missing: bytes, end: bytes, heads: Sequence[bytes] = ()) -> bytes:
    """Return rows as text: a number for each value, separated by tabs, and the end.

    ``values`` has the shape (rows, columns). ``missing`` (up to 3 bytes) stands for NaN, infinity and numbers
    that no 32-bit float can hold. ``heads`` are further first cells of the rows, if there are any.
    """
    num_rows = len(values)
    with np.errstate(invalid="ignore"):  # any bits that are a NaN
        cells = _cells(values.astype(np.float64).ravel(), missing).reshape(num_rows, -1)
    parts = [cells, np.tile(np.frombuffer(end, np.uint8), (num_rows, 1))]
    if heads:
        parts.insert(0, np.array(heads, np.bytes_).view(np.uint8).reshape(num_rows, -1))
    else:
        cells[:, 0] = 0  # no tab
    return np.concatenate(parts, axis=1).tobytes().translate(None, b"\0")


def _cells(values: Array, missing: bytes) -> Array:
    """Return a tab and the text of each of ``values``, shape (values, 16); bytes that are not used are 0."""
    is_known = np.abs(values) < _POWERS[2 * _MAX_EXPONENT]
    sizes = np.abs(np.where(is_known, values, 0.0))
    is_zero = sizes <= _POWERS[0]
    sizes[is_zero] = 0.0
    exponents = np.floor(np.log10(np.where(is_zero, 1.0, sizes))).astype(np.int64)
    numbers = np.rint(sizes * _POWERS[_MAX_EXPONENT + _NUM_DIGITS - 1 - exponents])
    is_rounded_up = numbers >= 10**_NUM_DIGITS
    exponents += is_rounded_up
    rest = np.where(is_rounded_up, 10 ** (_NUM_DIGITS - 1), numbers).astype(np.uint32)

    cells = np.zeros((len(values), _CELL_BYTES), np.uint8)
    for column in range(_EXPONENT - 1, _FIRST_DIGIT + 1, -1):
        tenths = rest // 10
        cells[:, column] = rest - tenths * 10 + _ZERO
        rest = tenths
    cells[:, _FIRST_DIGIT + 1] = _POINT
    cells[:, _FIRST_DIGIT] = rest + _ZERO
    cells[:, 1] = np.where(values < 0, _MINUS, 0)
    cells[:, _EXPONENT] = _E
    cells[:, _EXPONENT + 1] = np.where(exponents < 0, _MINUS, _PLUS)
    tens, ones = np.divmod(np.abs(exponents), 10)
    cells[:, _EXPONENT + 2] = tens + _ZERO
    cells[:, _EXPONENT + 3] = ones + _ZERO
    cells[~is_known] = 0
    cells[~is_known, 1 : 1 + len(missing)] = np.frombuffer(missing, np.uint8)
    cells[:, 0] = _TAB
    return cells
