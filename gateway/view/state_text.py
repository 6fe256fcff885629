"""The state of a source in words: whether data come, and what its gateway reports."""

from collections.abc import Iterable
from typing import Final, NamedTuple

from gateway.live.live_data import LiveSource
from gateway.stream.status_text import Level, message_texts, stream_level
from gateway.view.texts import age_text, html_text

_MAX_CHARACTERS: Final = 300
_MAX_STREAMS: Final = 8


class State(NamedTuple):
    """A state in words, and how well it works."""

    level: Level
    text: str


def data_state(source: LiveSource) -> State:
    """Return whether data come now: "live", "no analog for 0.7 s", "no data for 12 s"."""
    age_s = source.age_s
    if age_s is None:
        return State(Level.WAITING, "no data yet")
    components = {key: each for key, each in sorted([*source.components.items()]) if key != "event"}
    stopped = {key: each for key, each in components.items() if each.is_stopped}
    if not stopped:
        return State(Level.GOOD, "live")
    if len(stopped) == len(components):
        newest_s = min(each.age_s or 0.0 for each in stopped.values())
        return State(Level.BAD, f"no data for {age_text(newest_s)}")
    texts = (f"no {key} for {age_text(each.age_s or 0.0)}" for key, each in stopped.items())
    return State(Level.BAD, ", ".join(texts))


def gateway_states(source: LiveSource) -> list[State]:
    """Return what the gateway says about each of its streams, in the words of its status line.

    If it says the same about all, that is one state. If the gateway is not heard, that is the state.
    """
    status, age_s = source.newest_status, source.status_age_s
    if source.is_silent:
        text = "no gateway heard" if age_s is None else f"gateway not heard for {age_text(age_s)}"
        return [State(Level.BAD, text)]
    if status is None:
        return []
    texts = message_texts(status)[:_MAX_STREAMS]
    levels = [stream_level(stream.state, stream.problem) for stream in status.streams]
    if len({text for _, text in texts}) == 1:
        return [State(levels[0], texts[0][1])]
    return [
        State(level, f"{components}: {text}")
        for level, (components, text) in zip(levels, texts, strict=False)
    ]


def states_html(states: Iterable[State]) -> str:
    """Return states as lines in their colours."""
    return "".join(  # the values of levels are classes of the style sheet
        f"<p class={state.level.value}>{html_text(state.text, _MAX_CHARACTERS)}</p>" for state in states
    )
