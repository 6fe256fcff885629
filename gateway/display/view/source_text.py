"""What the panel says about one source, as HTML: state, rates, latency, losses."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from gateway.display.live import LiveComponent, LiveData, LiveSource, Percentiles
from gateway.display.view.texts import (
    NONE,
    age_text,
    clock_text,
    count_text,
    counted,
    html_text,
    percentiles_text,
    rate_text,
    table,
)
from gateway.logs.losses import counts_text
from gateway.messages.source_report import Level, LossReport, SourceReport, State
from gateway.rtc3d.components import WIRE_ORDER
from gateway.stream.status import FRAME_REJECTED, NOT_SENT, SKIPPED

_MAX_CHARACTERS: Final = 300


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
    report, age_s = source.report, source.status_age_s
    if source.is_silent:
        text = "no gateway heard" if age_s is None else f"gateway not heard for {age_text(age_s)}"
        return [State(Level.BAD, text)]
    streams = report.streams if report else ()
    if len({stream.text for stream in streams}) == 1:
        return [State(streams[0].level, streams[0].text)]
    return [State(stream.level, f"{stream.components}: {stream.text}") for stream in streams]


def states_html(states: Iterable[State]) -> str:
    """Return states as lines in their colours."""
    return "".join(  # the values of levels are classes of the style sheet
        f"<p class={state.level.value}>{html_text(state.text, _MAX_CHARACTERS)}</p>" for state in states
    )


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
        server = _dropped(source.report, key, NOT_SENT)
        gateway = _dropped(source.report, key, FRAME_REJECTED, SKIPPED)
        # Skipped messages have numbers: those skipped since this view began are gaps here, too.
        skipped = _dropped(source.report, key, SKIPPED) - _dropped(source.first_report, key, SKIPPED)
        gaps = source.series_by_key[key].check.num_lost - skipped
        figures[key] = (server, gateway, max(0, gaps) + component.num_skipped + component.num_malformed)
    if any(map(any, figures.values())):
        for key, places in figures.items():
            yield (key, *map(_figure, places), _figure(sum(places)))


def _output_rows(source: LiveSource) -> Iterator[tuple[str, ...]]:
    """Yield what each output of the gateway has dropped, of all components together."""
    for output in source.report.outputs if source.report else ():
        dropped = sum(loss.num_messages for loss in output.losses)
        if dropped:
            yield f"output {html_text(output.output)}", NONE, _figure(dropped), NONE, _figure(dropped)


def _figure(number: int) -> str:
    return f"<span class=bad>{count_text(number)}</span>" if number else "0"


def _dropped(report: SourceReport | None, key: str, *causes: str) -> int:
    """Return how many messages of a component were lost before any output: one in each frame.

    Events are not in every frame, so they are not counted.
    """
    return sum(
        loss.num_frames
        for stream in (report.streams if report and key != "event" else ())
        if {key, "all"} & {*stream.components.split()}
        for loss in stream.losses
        if loss.cause in causes
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
    if source.report is not None:
        yield from _report_causes(source.report)


def _report_causes(report: SourceReport) -> Iterator[tuple[Level, str]]:
    """Say what the gateway has lost since its start, and what its streams and outputs lack."""
    for stream in report.streams:
        name = html_text(stream.components)
        if stream.losses:
            yield Level.WAITING, f"dropped at {name}: {_drops(stream.losses)}"
        for limitation in stream.limitations:
            yield Level.WAITING, f"{name}: {html_text(limitation, _MAX_CHARACTERS)}"
        if stream.last_error:
            at = clock_text(stream.last_error_utime / 1e6)
            error = html_text(stream.last_error, _MAX_CHARACTERS)
            yield Level.WAITING, f"last error of {name}, {at}: {error}"
    for output in report.outputs:
        name = html_text(output.output)
        if not output.is_connected:
            problem = html_text(output.problem or NONE, _MAX_CHARACTERS)
            yield Level.BAD, f"output {name}: {problem}"
        if output.losses:
            yield Level.WAITING, f"dropped at output {name}: {_drops(output.losses)}"


def _drops(losses: Sequence[LossReport]) -> str:
    return html_text(counts_text(losses), _MAX_CHARACTERS)


_CLOCKS_DIFFER_MS: Final = (-0.5, 1000.0)
"""A median latency between computers outside of these says that their clocks differ."""


def source_html(
    source: LiveSource, shown: Mapping[str, Percentiles], *, is_take: bool, is_paused: bool = False
) -> str:
    """Return everything about a source but its markers, tools and events.

    ``shown`` is the latency from the arrival here to the browsers, by component. A take has no gateway now,
    so its latency to here is left out, and if it ``is_paused``, it has no rate.
    """
    parts = [f"<h3>{html_text(source.name)}</h3>"]
    if not (is_take and (source.is_silent or is_paused)):
        parts.append(states_html(gateway_states(source)))
    parts += [f"<p class=dim>{line}</p>" for line in _origin(source)]
    components = _components(source)
    if components:
        parts.append(_rates_table(source, components, is_take=is_take, is_paused=is_paused))
        parts.append(_latency_table(components, shown, is_take=is_take))
        parts += [f"<p class=waiting>{text}</p>" for text in clock_warning(components) if not is_take]
    parts.append(losses_html(source, components))
    return f"<section>{''.join(parts)}</section>"


def ignored_html(live: LiveData) -> str:
    """Say what was received and belongs to no source."""
    ignored = (
        (live.num_foreign, "of another program"),
        (live.num_beyond, "of more sources or keys than can be shown"),
        (live.num_defects, "because of a defect in this program"),
    )
    texts = [f"{counted(number, 'message')} {why}" for number, why in ignored if number]
    return f"<p class=waiting>left out: {', '.join(texts)}</p>" if texts else ""


def clock_warning(components: Mapping[str, LiveComponent]) -> Iterator[str]:
    """Say that latencies from the gateway to this program are wrong, if the clocks seem to differ."""
    medians = [each.latency.to_here.p50_ms for each in components.values() if each.latency.to_here]
    low_ms, high_ms = _CLOCKS_DIFFER_MS
    worst_ms = max(medians, key=abs, default=0.0)
    if worst_ms < low_ms:
        yield (
            f"This computer’s clock is at least {age_text(-worst_ms / 1000)} behind that of the gateway’s "
            "computer, so the latency from there to here is not known."
        )
    elif worst_ms > high_ms:
        yield (
            f"Messages seem to take {age_text(worst_ms / 1000)} from the gateway to here. Probably the "
            "clocks of the two computers differ."
        )


def _components(source: LiveSource) -> dict[str, LiveComponent]:
    # Threads that receive add components, and after each the series of its messages.
    keys = [each.key for each in WIRE_ORDER if each.key in source.series_by_key]
    return {key: source.components[key] for key in keys}


def _origin(source: LiveSource) -> Iterator[str]:
    """Say where the data come from, and whether the gateway records them."""
    report = source.report
    if report is None:
        return
    on_host = f" on {html_text(report.host)}" if report.host else ""
    yield f"server {html_text(report.server)} · gateway {html_text(report.version)}{on_host}"
    if source.running_take is not None and not source.is_silent:
        yield (
            f"recording the take {html_text(source.running_take)}"
            if source.running_take
            else "recording no take"
        )


def _rates_table(
    source: LiveSource, components: Mapping[str, LiveComponent], *, is_take: bool, is_paused: bool
) -> str:
    rows = []
    for key, component in components.items():
        rows.append(
            (
                key,
                count_text(len(component.newest_items)) if key != "event" else "",
                _rate(component, is_take=is_take, is_paused=is_paused) if key != "event" else "",
                count_text(source.series_by_key[key].num_messages),
            )
        )
    return table(("", "items", "Hz", "messages"), rows)


def _rate(component: LiveComponent, *, is_take: bool, is_paused: bool) -> str:
    """Return the rate, and the announced one if there is one. That of a take depends on its speed."""
    if component.is_stopped:
        return f"<span class=bad>stopped {age_text(component.age_s or 0.0)} ago</span>"
    if is_paused:
        return "paused"
    announced_hz = component.announced_rate_hz
    text = rate_text(component.rate_hz)
    if announced_hz is None:
        return text
    if component.is_slow and not is_take:
        text = f"<span class=waiting>{text}</span>"
    return f"{text} <span class=dim>of {rate_text(announced_hz)}</span>"


def _latency_table(
    components: Mapping[str, LiveComponent], shown: Mapping[str, Percentiles], *, is_take: bool
) -> str:
    headings = ("ms, p50 / p99", "captured → gateway", "→ here", "→ browser")
    rows = [
        (
            key,
            percentiles_text(component.latency.to_gateway),
            percentiles_text(component.latency.to_here),
            percentiles_text(shown.get(key)),
        )
        for key, component in components.items()
    ]
    if is_take:
        return table(headings[:2], [row[:2] for row in rows])
    return table(headings, rows)
