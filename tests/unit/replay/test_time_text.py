"""Times in a take as texts."""

import pytest

from gateway.replay.time_text import time_text


@pytest.mark.parametrize(
    ("duration_us", "text"),
    [
        (0, "0:00:00.0"),
        (62_590_000, "0:01:02.5"),
        (3_599_999_999, "0:59:59.9"),
        (7_262_500_000, "2:01:02.5"),
        (-2_000_000, "-0:00:02.0"),
    ],
)
def test_times_have_hours_minutes_seconds_and_tenths(duration_us: int, text: str) -> None:
    assert time_text(duration_us) == text
