"""The top of the panel, as HTML: whether the picture is live, and when data last came."""

from collections.abc import Sequence
from typing import Final

from gateway.live.live_data import LiveSource
from gateway.stream.status_text import Level
from gateway.view.state_text import State, data_state, gateway_states
from gateway.view.texts import clock_text, counted, html_text

MAX_SOURCES: Final = 16
"""How many sources the panel shows."""

_MAX_CHARACTERS: Final = 160


def banner_html(
    sources: Sequence[LiveSource], now_s: float, *, is_take: bool = False, is_paused: bool = False
) -> str:
    """Return a line for each source: red, with the reason, if its data have stopped.

    ``now_s`` is the time since the Unix epoch. ``is_paused`` is for takes: nothing comes, on purpose.
    """
    if not sources:
        lines = f"<p class=waiting>{'The take begins.' if is_take else 'No source is heard yet.'}</p>"
    else:
        lines = "".join(
            _take_line(source, is_paused=is_paused) if is_take else _live_line(source, now_s)
            for source in sources[:MAX_SOURCES]
        )
    if len(sources) > MAX_SOURCES:
        lines += f"<p class=dim>and {counted(len(sources) - MAX_SOURCES, 'more source')}</p>"
    # The second changes as long as this program runs; otherwise, the page itself says so (style.py).
    return f"<section data-second={int(now_s)}>{lines}</section>"


def _live_line(source: LiveSource, now_s: float) -> str:
    state, age_s = data_state(source), source.age_s
    take = ""
    if source.running_take and not source.is_silent:
        take = f"<p><span class=bad>● recording</span> {html_text(source.running_take, _MAX_CHARACTERS)}</p>"
    last = "" if age_s is None else f"last data {clock_text(now_s - age_s)}"
    if state.level is not Level.BAD:
        return _line(source, state, last) + take
    reasons = ", ".join(each.text for each in gateway_states(source) if each.level is not Level.GOOD)
    details = html_text(" · ".join(filter(None, (last, reasons))), _MAX_CHARACTERS)
    name, text = html_text(source.name), html_text(state.text, _MAX_CHARACTERS)
    return f"<div class=stopped><b>{name}: {text}</b>. The picture is old.<br>{details}</div>{take}"


def _take_line(source: LiveSource, *, is_paused: bool) -> str:
    state = data_state(source)
    if is_paused:
        return _line(source, State(Level.WAITING, "paused"), "")
    return _line(source, state._replace(text="recorded") if state.level is Level.GOOD else state, "")


def _line(source: LiveSource, state: State, last: str) -> str:
    text = html_text(state.text, _MAX_CHARACTERS)
    name = html_text(source.name)
    return (
        f"<p><span class={state.level.value}>● {text}</span> <b>{name}</b> <span class=last>{last}</span></p>"
    )
