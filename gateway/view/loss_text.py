"""What a source has lost, as HTML: for each component at the server, in the gateway and here, and why."""

from collections.abc import Iterator, Mapping
from typing import Final

import rtc3d

from gateway.live.component import LiveComponent
from gateway.live.live_data import LiveSource
from gateway.losses import counts_text
from gateway.stream.status import FRAME_REJECTED, NOT_SENT, SKIPPED
from gateway.stream.status_text import Level
from gateway.view.texts import NONE, clock_text, count_text, counted, html_text, table

_MAX_SENTENCE_CHARACTERS: Final = 300
_MAX_LINES: Final = 20
"""How many streams and outputs, each with its drops, are shown."""

_NOTE: Final = (
    "<p class=dim>Server and gateway: since the gateway’s start. Here: since this view’s start, on the way "
    "from the gateway to the picture.</p>"
)


def losses_html(source: LiveSource, components: Mapping[str, LiveComponent]) -> str:
    """Return what is lost, by component and place, and the causes."""
    rows = [*_component_rows(source, components), *_output_rows(source)]
    parts = [table(("lost messages", "server", "gateway", "here", "all"), rows), _NOTE] if rows else []
    parts += [f"<p class={level.value}>{text}</p>" for level, text in _causes(source, components)]
    return "".join(parts) or "<p class=good>nothing lost, dropped or skipped</p>"


def _component_rows(source: LiveSource, components: Mapping[str, LiveComponent]) -> Iterator[tuple[str, ...]]:
    """Yield the figures of each component; nothing if all are 0."""
    figures = {}
    for key, component in components.items():
        server = _dropped(source.newest_status, key, NOT_SENT)
        gateway = _dropped(source.newest_status, key, FRAME_REJECTED, SKIPPED)
        # Skipped messages have numbers: those skipped since this view began are gaps here, too.
        skipped = _dropped(source.newest_status, key, SKIPPED) - _dropped(source.first_status, key, SKIPPED)
        gaps = source.series_by_key[key].check.num_lost - skipped
        figures[key] = (server, gateway, max(0, gaps) + component.num_skipped + component.num_malformed)
    if any(map(any, figures.values())):
        for key, places in figures.items():
            yield (key, *map(_figure, places), _figure(sum(places)))


def _output_rows(source: LiveSource) -> Iterator[tuple[str, ...]]:
    """Yield what each output of the gateway has dropped, of all components together."""
    for output in source.newest_status.outputs[:_MAX_LINES] if source.newest_status else ():
        dropped = sum(drop.messages for drop in output.drops)
        if dropped:
            yield f"output {html_text(output.name)}", NONE, _figure(dropped), NONE, _figure(dropped)


def _figure(number: int) -> str:
    return f"<span class=bad>{count_text(number)}</span>" if number else "0"


def _dropped(status: rtc3d.status_t | None, key: str, *causes: str) -> int:
    """Return how many messages of a component were lost before any output: one in each frame.

    Events are not in every frame, so they are not counted.
    """
    return sum(
        drop.frames
        for stream in (status.streams if status and key != "event" else ())
        if {key, "all"} & {*stream.components.split()}
        for drop in stream.drops
        if drop.cause in causes
    )


def _causes(source: LiveSource, components: Mapping[str, LiveComponent]) -> Iterator[tuple[Level, str]]:
    """Say why something is lost, skipped or wrong anywhere."""
    for key, component in components.items():
        check = source.series_by_key[key].check
        if check.num_lost:
            yield Level.BAD, f"{key}: {counted(check.num_gaps, 'gap')} in the numbers of the messages"
        if check.num_restarts:
            yield Level.WAITING, f"{key}: numbers restarted {counted(check.num_restarts, 'time')}"
        if check.has_two_publishers:
            yield Level.BAD, f"{key}: two gateways publish on the same key"
        if component.num_malformed:
            yield Level.BAD, f"{key}: {counted(component.num_malformed, 'malformed message')}"
    if source.num_skipped:
        yield Level.WAITING, f"skipped for display: {counted(source.num_skipped, 'message')}"
    if source.num_unreadable:
        unreadable = counted(source.num_unreadable, "message")
        yield Level.BAD, f"parameters or status that cannot be read: {unreadable}"
    if source.newest_status is not None:
        yield from _status_causes(source.newest_status)


def _status_causes(status: rtc3d.status_t) -> Iterator[tuple[Level, str]]:
    """Say what the gateway has lost since its start, and what its streams and outputs lack."""
    for stream in status.streams[:_MAX_LINES]:
        name = html_text(stream.components)
        if stream.drops:
            yield Level.WAITING, f"dropped at {name}: {_drops(stream.drops)}"
        for limitation in stream.limitations[:_MAX_LINES]:
            yield Level.WAITING, f"{name}: {html_text(limitation, _MAX_SENTENCE_CHARACTERS)}"
        if stream.last_error:
            at = clock_text(stream.last_error_utime / 1e6)
            error = html_text(stream.last_error, _MAX_SENTENCE_CHARACTERS)
            yield Level.WAITING, f"last error of {name}, {at}: {error}"
    for output in status.outputs[:_MAX_LINES]:
        if not output.connected:
            problem = html_text(output.problem or NONE, _MAX_SENTENCE_CHARACTERS)
            yield Level.BAD, f"output {html_text(output.name)}: {problem}"
        if output.drops:
            yield Level.WAITING, f"dropped at output {html_text(output.name)}: {_drops(output.drops)}"


def _drops(drops: list[rtc3d.loss_t]) -> str:
    texts = counts_text((drop.cause, drop.messages, drop.frames) for drop in drops[:_MAX_LINES])
    return html_text(texts, _MAX_SENTENCE_CHARACTERS)
