"""Tables of markers and tools by visibility, and of the newest events, as HTML."""

from typing import Final

import numpy as np

from gateway.live.component import LiveComponent
from gateway.live.live_data import LiveSource
from gateway.takes.component_rows import Array
from gateway.view.texts import NONE, counted, event_time_text, html_text, share_text, table, value_text

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
