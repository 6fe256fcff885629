"""Numbers as texts for people, and text from the network as HTML."""

import html
import math
import time
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from gateway.display.live import LiveComponent, LiveSource, Percentiles, visible_percent
from gateway.logs.safe_text import safe_text
from gateway.takes.files.component_rows import Array

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


MAX_ROWS: Final = 40
"""How many markers and how many tools of a source are shown, those first that are visible least often."""

_MAX_EVENT_CHARACTERS: Final = 200

_LEGEND: Final = (
    "<p class=legend>A name in <span class=bad>red</span> is missing in the newest frame. Bars: "
    "<span class=good>always visible</span>, <span class=waiting>90 % or more</span>, "
    "<span class=bad>less</span>.</p>"
)


def items_html(source: LiveSource) -> str:
    """Return the markers and tools of a source with their visibility over the last seconds."""
    parts = [f"<h3>{html_text(source.name)}</h3>"]
    markers, tools = source.components.get("3d"), source.components.get("6d")
    if markers is None and tools is None:
        parts.append("<p class=dim>no markers and no tools</p>")
    else:
        parts.append(_LEGEND)
    if tools is not None:
        parts.append(_visibility_html(tools, "tool"))
    if markers is not None:
        parts.append(_visibility_html(markers, "marker"))
    return f"<section class=items>{''.join(parts)}</section>"


def worst_first(shares: Array) -> list[int]:
    """Return the indices of items by their visibility, the least visible first; equal ones in their order."""
    indices: list[int] = np.argsort(shares, kind="stable").tolist()
    return indices


def _visibility_html(component: LiveComponent, noun: str) -> str:
    shares, num_items = component.visible_shares, len(component.newest_items)
    if not len(shares):
        return f"<p class=dim>{counted(num_items, noun)}, no frames in the last 10 s</p>"
    is_visible = component.is_visible
    units, labels = component.description.units, component.description.labels
    rows = []
    for index in worst_first(shares)[:MAX_ROWS]:
        name = html_text(labels[index])
        if component.is_stopped:
            name = f"<span class=dim>{name}</span>"
        elif not is_visible[index]:
            name = f"<span class=bad>{name}</span>"
        # Markers have an empty column, so that the bars of both tables align.
        error = ""
        if noun == "tool":
            value = float(component.newest_items["error"][index])
            error = f"{value_text(value)} {html_text(units[index])}" if is_visible[index] else NONE
        rows.append((name, _bar(float(shares[index])), error))
    headings = (f"{counted(num_items, noun)}", "visible, last 10 s", "error" if noun == "tool" else "")
    return table(headings, rows) + _rest(shares, noun)


def _bar(share: float) -> str:
    level = "good" if share == 1 else "waiting" if share >= 0.9 else "bad"
    width = f"<i class={level} style=width:{100 * share:.0f}%></i>"
    return f"<span class=bar>{width}</span><span class=share>{share_text(share)}</span>"


def _rest(shares: Array, noun: str) -> str:
    num_hidden = len(shares) - MAX_ROWS
    if num_hidden <= 0:
        return ""
    least = float(np.sort(shares)[MAX_ROWS])
    how = "always visible" if least == 1 else f"visible in at least {share_text(least)} of the frames"
    return f"<p class=dim>{counted(num_hidden, f'more {noun}')}, {how}</p>"


def events_html(source: LiveSource) -> str:
    """Return the newest events of a source, the newest one first."""
    rows = [
        (
            event_time_text(event.capture_utime),
            html_text(event.text.label),
            html_text(event.text.description, _MAX_EVENT_CHARACTERS),
        )
        for event in reversed([*source.events])
    ]
    events = table(("captured", "event", ""), rows) if rows else "<p class=dim>no events yet</p>"
    return f"<section class=events><h3>{html_text(source.name)}</h3>{events}</section>"
