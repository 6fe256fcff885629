"""Numbers as texts, and text from the network as HTML."""

import math

import pytest

from gateway.live.latency import Percentiles
from gateway.view.texts import (
    NONE,
    age_text,
    clock_text,
    counted,
    event_time_text,
    html_text,
    milliseconds_text,
    percentiles_text,
    rate_text,
    share_text,
    value_text,
)


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("<img src=x onerror=alert(1)>", "&lt;img src=x onerror=alert(1)&gt;"),
        ("[x](http://192.0.2.1)", "[x](http://192.0.2.1)"),
        ("a\"b&c'", "a&quot;b&amp;c&#x27;"),
        ("a\nb\x1b", "a\\nb\\x1b"),
        ("ab\N{RIGHT-TO-LEFT OVERRIDE}cd", "ab\\u202ecd"),
    ],
)
def test_text_from_the_network_is_shown_and_is_no_html(text: str, html: str) -> None:
    assert html_text(text) == html


def test_long_text_is_cut_before_it_is_escaped() -> None:
    assert html_text("<" * 1_000_000, 5) == "&lt;" * 4 + "…"


@pytest.mark.parametrize(
    ("rate_hz", "text"),
    [
        (0, "0.0"),
        (59.94, "59.9"),
        (199.96, "200.0"),
        (999.96, "1000"),
        (2000.4, "2000"),
        (None, NONE),
        (math.nan, NONE),
    ],
)
def test_rates(rate_hz: float | None, text: str) -> None:
    assert rate_text(rate_hz) == text


@pytest.mark.parametrize(
    ("value_ms", "text"),
    [
        (0.123, "0.12"),
        (9.996, "10.0"),
        (12.34, "12.3"),
        (-3.456, "-3.46"),
        (99.96, "100"),
        (1234.4, "1234"),
        (math.inf, NONE),
    ],
)
def test_latencies(value_ms: float, text: str) -> None:
    assert milliseconds_text(value_ms) == text


def test_percentiles() -> None:
    assert percentiles_text(Percentiles(1.25, 15.04)) == "1.25 / 15.0"
    assert percentiles_text(None) == NONE


@pytest.mark.parametrize(
    ("share", "text"), [(0, "0 %"), (1, "100 %"), (0.9999, "99.9 %"), (0.00001, "0.1 %"), (0.5, "50.0 %")]
)
def test_only_all_frames_are_100_percent(share: float, text: str) -> None:
    assert share_text(share) == text


@pytest.mark.parametrize(
    ("age_s", "text"),
    [
        (-1, "0.0 s"),
        (0.74, "0.7 s"),
        (9.96, "9 s"),
        (59.9, "59 s"),
        (185, "3 min 5 s"),
        (8040, "2 h 14 min"),
        (259_200, "3 days"),
    ],
)
def test_ages(age_s: float, text: str) -> None:
    assert age_text(age_s) == text


def test_local_times() -> None:
    assert len(clock_text(1_700_000_000)) == len("14:03:22")
    assert event_time_text(1_700_000_000_125_999).endswith(":20.125")


@pytest.mark.parametrize("utime", [1 << 62, -(1 << 63), (1 << 63) - 1])
def test_times_that_no_calendar_has(utime: int) -> None:
    assert event_time_text(utime)


def test_counts_and_values() -> None:
    assert counted(1, "marker") == "1 marker"
    assert counted(12345, "marker") == "12,345 markers"
    assert value_text(0.20849) == "0.208"
    assert value_text(math.nan) == NONE
