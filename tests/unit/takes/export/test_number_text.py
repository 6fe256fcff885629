"""Numbers as text in bulk: Python reads back what was written."""

import numpy as np

from gateway.takes.export.number_text import number_rows, rounded


def test_digits_can_be_rounded_up_to_a_power_of_ten() -> None:
    values = np.array([[9.9999999999, -99.99999999999, 0.9999999996, 0.1234567894]])
    assert number_rows(rounded(values)) == [b"10.0,-100.0,1.0,0.123456789"]


def test_missing_values_and_separators() -> None:
    values = np.array([[np.nan, 1.0], [2.0, np.inf]], np.float32)
    assert number_rows(values, b"n/a", b"\t") == [b"n/a\t1.0", b"2.0\tn/a"]
    assert number_rows(values[:, :0]) == [b"", b""]
    assert number_rows(values[:0]) == []


def test_numbers_are_read_back_exactly() -> None:
    """Any 32-bit float has the same bits after it was text, also after another unit: 9 digits are enough."""
    bits = np.random.default_rng(6).integers(0, 2**32, 20_000, np.uint32)
    edges = [0, 1e-45, -1.17549435e-38, 3.4028235e38, 1, 9.9999999e9, 0.1, -999999999, 1e23, np.nan, np.inf]
    values = np.concatenate([bits.view(np.float32), np.array(edges, np.float32)])[:, None]
    expected = np.where(np.isfinite(values), values, np.nan)
    with np.errstate(invalid="ignore"):  # any bits that are a NaN
        wide = values.astype(np.float64)
    for written, factor in ((values, 1), (rounded(wide), 1), (rounded(wide * 1e-3), 1e3)):
        found = [float(text or "nan") * factor for text in number_rows(written)]
        assert np.array_equal(np.array(found, np.float32)[:, None], expected, equal_nan=True)
    assert number_rows(rounded(np.array([[1e-320, -0.0]]))) == [b"1e-320,-0.0"]
