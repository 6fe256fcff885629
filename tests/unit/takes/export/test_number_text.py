"""Numbers as text in bulk: Python reads back what was written."""

import numpy as np

from gateway.takes.export.number_text import encode_rows


def test_digits_can_be_rounded_up_to_a_power_of_ten() -> None:
    values = np.array([[9.9999999999, -99.99999999999, 0.9999999996]])
    assert encode_rows(values, b"", b"\n") == b"1.00000000e+01\t-1.00000000e+02\t1.00000000e+00\n"


def test_missing_values_heads_and_ends() -> None:
    values = np.array([[np.nan, 1.0], [2.0, np.inf]])
    assert encode_rows(values, b"n/a", b";\n", [b"a", b"bc"]) == (
        b"a\tn/a\t1.00000000e+00;\nbc\t2.00000000e+00\tn/a;\n"
    )


def test_numbers_are_read_back_exactly() -> None:
    """Any 32-bit float has the same bits after it was text: 9 digits are enough."""
    bits = np.random.default_rng(6).integers(0, 2**32, 20_000, np.uint32)
    edges = [0, 1e-45, -1.17549435e-38, 3.4028235e38, 1, 9.9999999e9, 0.1, -999999999, 1e23, np.nan, np.inf]
    values = np.concatenate([bits.view(np.float32), np.array(edges, np.float32)])
    text = encode_rows(values[:, None], b"nan", b"\n", [b"7"] * len(values))
    rows = [line.split(b"\t") for line in text.splitlines()]
    assert {head for head, _ in rows} == {b"7"}
    found = np.array([float(cell) for _, cell in rows]).astype(np.float32)
    assert np.array_equal(found, np.where(np.isfinite(values), values, np.nan), equal_nan=True)
    assert text.splitlines()[-11] == b"7\t0.00000000e+00"
    assert encode_rows(np.array([[0.99999999996]]), b"", b"\n", [b"7"]) == b"7\t1.00000000e+00\n"
    assert encode_rows(np.array([[1e-90, -1e90]]), b"", b"\t\n", [b"7"]) == b"7\t0.00000000e+00\t\t\n"
