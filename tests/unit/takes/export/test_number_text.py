"""Numbers as text in bulk: Python reads back what was written."""

import numpy as np

from gateway.takes.export.number_text import encode_rows


def test_each_32_bit_float_is_read_back_exactly() -> None:
    """Among them those whose digits are rounded up to the next power of ten."""
    random = np.random.default_rng(3).integers(0, 1 << 32, 20_000, np.uint32).view(np.float32)
    special = [0.0, -0.0, 1e-45, 3.4028235e38, 0.1, 9.99999999, 99.99999999, 0.09999999999, -1000.0]
    values = np.concatenate([random[np.isfinite(random)], np.array(special, np.float32)])
    values = values[: len(values) // 8 * 8].reshape(-1, 8)
    text = encode_rows(values, b"n/a", b"\n").decode()
    assert text.endswith("\n")
    rows = [[float(cell) for cell in line.split("\t")] for line in text.splitlines()]
    assert np.array_equal(np.array(rows, np.float32), values)


def test_digits_can_be_rounded_up_to_a_power_of_ten() -> None:
    values = np.array([[9.9999999999, -99.99999999999, 0.9999999996]])
    assert encode_rows(values, b"", b"\n") == b"1.00000000e+01\t-1.00000000e+02\t1.00000000e+00\n"


def test_missing_values_heads_and_ends() -> None:
    values = np.array([[np.nan, 1.0], [2.0, np.inf]])
    assert encode_rows(values, b"n/a", b";\n", [b"a", b"bc"]) == (
        b"a\tn/a\t1.00000000e+00;\nbc\t2.00000000e+00\tn/a;\n"
    )
