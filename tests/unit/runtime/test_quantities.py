"""How numbers with units look."""

from gateway.runtime.quantities import age_text, counted, duration_text, rate_text, size_text


def test_counts_and_sizes() -> None:
    assert [counted(each, "marker") for each in (0, 1, 12345)] == ["0 markers", "1 marker", "12345 markers"]
    sizes = (0, 999, 1000, 999_960, 2.5e9)
    assert [size_text(each) for each in sizes] == ["0 bytes", "999 bytes", "1.0 kB", "1.0 MB", "2.5 GB"]


def test_durations() -> None:
    """What rounds to a minute is one; what is shorter than a second keeps its milliseconds."""
    durations = (0, 0.0125, 0.9996, 12.34, 59.96, 3600.04, 7384.5)
    texts = ["0.0 s", "0.013 s", "1.0 s", "12.3 s", "1 min 0.0 s", "1 h 0 min 0.0 s", "2 h 3 min 4.5 s"]
    assert [duration_text(each) for each in durations] == texts
    ages = (-1, 0.74, 9.96, 59.9, 185, 8040, 259_200)
    texts = ["0.0 s", "0.7 s", "9 s", "59 s", "3 min 5 s", "2 h 14 min", "3 days"]
    assert [age_text(each) for each in ages] == texts


def test_rates() -> None:
    rates = (0, 0.5, 59.94, 199.96, 999.96, 2000.4)
    assert [rate_text(each) for each in rates] == ["0", "0.5", "59.9", "200", "1000", "2000"]
