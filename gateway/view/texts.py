"""Numbers as texts for people, and text from the network as HTML."""

import html
import math
import time
from collections.abc import Iterable, Sequence
from typing import Final

from gateway.live.latency import Percentiles
from gateway.live.visibility import visible_percent
from gateway.safe_text import safe_text

NONE: Final = "–"
"""Stands for a number that is not known."""

MAX_LABEL_CHARACTERS: Final = 40

_MINUTE_S: Final = 60
_HOUR_S: Final = 3600


def html_text(text: str, max_characters: int = MAX_LABEL_CHARACTERS) -> str:
    """Return text from the network as HTML that shows it, on one line, cut to ``max_characters``."""
    return html.escape(safe_text(text, max_characters))


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; its cells are HTML."""
    head = "".join(f"<th>{heading}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def count_text(number: int) -> str:
    """Return a whole number, such as "12,345"."""
    return f"{number:,}"


def counted(number: int, noun: str) -> str:
    """Return a number of things, such as "1 source" or "12,345 sources"."""
    return f"{count_text(number)} {noun}{'' if number == 1 else 's'}"


def rate_text(rate_hz: float | None) -> str:
    """Return a rate in Hz with a precision that suits it: "2000", "199.9", "0.5"."""
    if rate_hz is None or not math.isfinite(rate_hz):
        return NONE
    return f"{rate_hz:.0f}" if rate_hz >= 999.95 else f"{rate_hz:.1f}"


def milliseconds_text(value_ms: float) -> str:
    """Return a latency in ms: "0.42", "12.3", "1234"."""
    if not math.isfinite(value_ms):
        return NONE
    size = abs(value_ms)
    return f"{value_ms:.{2 if size < 9.995 else 1 if size < 99.95 else 0}f}"


def percentiles_text(percentiles: Percentiles | None) -> str:
    """Return a latency as "p50 / p99" in ms."""
    if percentiles is None:
        return NONE
    return f"{milliseconds_text(percentiles.p50_ms)} / {milliseconds_text(percentiles.p99_ms)}"


def share_text(share: float) -> str:
    """Return a share from 0 to 1 in %. Only a share of exactly 0 or 1 is "0 %" or "100 %"."""
    return f"{visible_percent(share):.{0 if share in {0, 1} else 1}f} %"


def age_text(age_s: float) -> str:
    """Return how long something takes or is ago: "0.3 s", "12 s", "3 min 5 s", "2 h 14 min", "3 days"."""
    if age_s < 9.95:
        return f"{max(age_s, 0.0):.1f} s"
    seconds = int(age_s)
    if seconds < _MINUTE_S:
        return f"{seconds} s"
    if seconds < _HOUR_S:
        return f"{seconds // _MINUTE_S} min {seconds % _MINUTE_S} s"
    if seconds < 48 * _HOUR_S:
        return f"{seconds // _HOUR_S} h {seconds % _HOUR_S // _MINUTE_S} min"
    return f"{seconds // (24 * _HOUR_S)} days"


def clock_text(time_s: float) -> str:
    """Return a time since the Unix epoch as local time, such as "14:03:22"; NONE if there is no such time."""
    try:
        return time.strftime("%H:%M:%S", time.localtime(time_s))
    except (ValueError, OverflowError, OSError):
        return NONE


def event_time_text(utime: int) -> str:
    """Return µs since the Unix epoch as local time with milliseconds, such as "14:03:22.125"."""
    text = clock_text(utime // 1_000_000)
    return text if text == NONE else f"{text}.{utime % 1_000_000 // 1000:03d}"


def value_text(value: float) -> str:
    """Return a value of a measurement with three significant digits."""
    return f"{value:.3g}" if math.isfinite(value) else NONE
