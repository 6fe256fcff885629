"""What the panel says about sources, as HTML; numbers as texts, and text from the network as HTML."""

import html
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from gateway.messages.source_report import Level, SourceReport, State
from gateway.rtc3d.components import WIRE_ORDER
from gateway.runtime.losses import counts_text
from gateway.runtime.quantities import age_text, counted, rate_text
from gateway.runtime.safe_text import safe_text
from gateway.session.status import FRAME_REJECTED, NOT_SENT, SKIPPED
from gateway.tools.display.live import DisplayedSource, LiveComponent, LiveData
from gateway.tools.display.statistics import Percentiles, visible_percent

NONE: Final = "–"
"""Stands for a number that is not known."""

MAX_LABEL_CHARACTERS: Final = 40

_MAX_CHARACTERS: Final = 300
"""How much of a sentence about a source is shown."""


def html_text(text: str, max_characters: int = MAX_LABEL_CHARACTERS) -> str:
    """Return text from the network as HTML that shows it, on one line, cut to ``max_characters``."""
    return html.escape(safe_text(text, max_characters))


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; its cells are HTML."""
    head = "".join(f"<th>{heading}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def known_rate_text(rate_hz: float | None) -> str:
    """Return a rate in Hz; NONE if it is not known."""
    return NONE if rate_hz is None or not math.isfinite(rate_hz) else rate_text(rate_hz)


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


def data_state(source: DisplayedSource) -> State:
    """Return whether data come now: "live", "no analog for 0.7 s", "no data for 12 s"."""
    age_s = source.age_s
    if age_s is None:
        return State(Level.WAITING, "no data yet")
    known = {key: each for key, each in sorted([*source.components.items()]) if key != "event"}
    components = {key: each for key, each in known.items() if each.age_s is not None}
    if known and not components:  # only an event, and others that the history still has to send
        return State(Level.WAITING, "no data yet")
    stopped = {key: each for key, each in components.items() if each.is_stopped}
    if not stopped:
        return State(Level.GOOD, "live")
    if len(stopped) == len(components):
        newest_s = min(each.age_s or 0.0 for each in stopped.values())
        return State(Level.BAD, f"no data for {age_text(newest_s)}")
    texts = (f"no {key} for {age_text(each.age_s or 0.0)}" for key, each in stopped.items())
    return State(Level.BAD, ", ".join(texts))


_MAX_NOTICES: Final = 3


def notice_text(sources: Sequence[DisplayedSource], now_s: float) -> str:
    """Return a line for each source whose data have stopped: since when, and what the gateway knows.

    ``now_s`` is the time since the Unix epoch. Nothing in the text changes from second to second.
    """
    lines = []
    for source in sources:
        if source.is_stopped:
            since = clock_text(now_s - (_stopped_s(source) or 0.0))
            reasons = ", ".join(each.text for each in gateway_states(source) if each.level is not Level.GOOD)
            name = safe_text(source.name, MAX_LABEL_CHARACTERS)
            text = f"{name}: {_stopped_text(source)} since {since}"
            lines.append(safe_text(" · ".join(filter(None, (text, reasons))), _MAX_CHARACTERS))
    if len(lines) > _MAX_NOTICES:
        lines[_MAX_NOTICES:] = [f"and {counted(len(lines) - _MAX_NOTICES, 'more source')}"]
    return "\n".join(lines)


def title_text(sources: Sequence[DisplayedSource], states: Sequence[State]) -> str:
    """Return the title of the panel with the worst state: on phones, it is all that a closed panel shows."""
    if not sources:
        return "rtc3d-gateway · no source yet"
    levels = [*Level]
    state, source = max(zip(states, sources, strict=True), key=lambda each: levels.index(each[0].level))
    text = _stopped_text(source) if state.level is Level.BAD else state.text
    others = f" (of {len(sources)} sources)" if len(sources) > 1 else ""
    return f"rtc3d-gateway · {safe_text(source.name, MAX_LABEL_CHARACTERS)} {text}{others}"


def _stopped_s(source: DisplayedSource) -> float | None:
    """Return how long ago the newest data came of what has stopped; None if nothing has."""
    ages_s = (each.age_s for each in [*source.components.values()] if each.is_stopped)
    return min((age_s for age_s in ages_s if age_s is not None), default=None)


def _stopped_text(source: DisplayedSource) -> str:
    """Return which components have stopped: "no data" if all have."""
    components = sorted([*source.components.items()])
    known = [(key, each) for key, each in components if key != "event" and each.age_s is not None]
    stopped = [key for key, each in known if each.is_stopped]
    return "no data" if len(stopped) == len(known) else f"no {', '.join(stopped)}"


def gateway_states(source: DisplayedSource) -> list[State]:
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


_CLOCKS_DIFFER_MS: Final = (-0.5, 1000.0)
"""A median latency between computers outside of these says that their clocks differ."""


def source_html(source: DisplayedSource, *, is_take: bool, is_paused: bool = False) -> str:
    """Return everything about a source but its markers, tools and events.

    A take has no gateway now, so its latency to here is left out, and if it ``is_paused``, it has no rate.
    """
    parts = [f"<h3>{html_text(source.name)}</h3>"]
    if not (is_take and (source.is_silent or is_paused)):
        states = (
            (each.level.value, html_text(each.text, _MAX_CHARACTERS)) for each in gateway_states(source)
        )
        parts += [f"<p class={level}>{text}</p>" for level, text in states]  # levels are classes of the style
    parts += [f"<p class=dim>{line}</p>" for line in _origin(source)]
    # Threads that receive add components, and after each the series of its messages.
    keys = [each.key for each in WIRE_ORDER if each.key in source.series_by_key]
    components = {key: source.components[key] for key in keys}
    rates, latencies = [], []
    for key, component in components.items():
        num_items = rate = ""
        if key != "event":
            num_items = f"{len(component.newest_items):,}"
            rate = _rate(component, is_take=is_take, is_paused=is_paused)
        rates.append((key, num_items, rate, f"{source.series_by_key[key].num_messages:,}"))
        latency = component.latency
        stages = (latency.to_gateway, latency.to_here, Percentiles.of([*latency.shown_ms]))
        latencies.append((key, *map(percentiles_text, stages[:1] if is_take else stages)))
    if components:
        headings = ("ms, p50 / p99", "captured → gateway", "→ here", "→ browser")
        parts.append(table(("", "items", "Hz", "messages"), rates))
        parts.append(table(headings[:2] if is_take else headings, latencies))
    if warning := "" if is_take else _clock_warning(components):
        parts.append(f"<p class=waiting>{warning}</p>")
    parts.append(_losses_html(source, components))
    return f"<section>{''.join(parts)}</section>"


def _rate(component: LiveComponent, *, is_take: bool, is_paused: bool) -> str:
    """Return the rate, and the announced one if there is one. That of a take depends on its speed."""
    if component.is_stopped:
        return f"<span class=bad>stopped {age_text(component.age_s or 0.0)} ago</span>"
    if is_paused:
        return "paused"
    announced_hz = component.announced_rate_hz
    text = known_rate_text(component.rate_hz)
    if announced_hz is None:
        return text
    if component.is_slow and not is_take:
        text = f"<span class=waiting>{text}</span>"
    return f"{text} <span class=dim>of {known_rate_text(announced_hz)}</span>"


def _clock_warning(components: Mapping[str, LiveComponent]) -> str:
    """Say that latencies from the gateway to this program are wrong, if the clocks seem to differ."""
    medians = [each.latency.to_here.p50_ms for each in components.values() if each.latency.to_here]
    low_ms, high_ms = _CLOCKS_DIFFER_MS
    worst_ms = max(medians, key=abs, default=0.0)
    if worst_ms < low_ms:
        return (
            f"This computer’s clock is at least {age_text(-worst_ms / 1000)} behind that of the gateway’s "
            "computer, so the latency from there to here is not known."
        )
    if worst_ms > high_ms:
        return (
            f"Messages seem to take {age_text(worst_ms / 1000)} from the gateway to here. Probably the "
            "clocks of the two computers differ."
        )
    return ""


def _origin(source: DisplayedSource) -> Iterator[str]:
    """Say where the data come from, and whether the gateway records them."""
    report = source.report
    if report is None:
        return
    on_host = f" on {html_text(report.host)}" if report.host else ""
    yield f"server {html_text(report.server)} · gateway {html_text(report.version)}{on_host}"
    if source.running_take is not None and not source.is_silent:
        take = html_text(source.running_take)
        yield f"recording the take {take}" if take else "recording no take"


_NOTE: Final = (
    "<p class=dim>Server and gateway: since the gateway’s start. Here: since this view’s start, on the way "
    "from the gateway to the picture.</p>"
)


def _losses_html(source: DisplayedSource, components: Mapping[str, LiveComponent]) -> str:
    """Return what is lost, by component and place, and the causes."""
    report, figures = source.report, {}
    for key, component in components.items():
        server = _dropped(report, key, NOT_SENT)
        gateway = _dropped(report, key, FRAME_REJECTED, SKIPPED)
        # Skipped messages have numbers: those skipped since this view began are gaps here, too.
        skipped = _dropped(report, key, SKIPPED) - _dropped(source.first_report, key, SKIPPED)
        gaps = source.series_by_key[key].check.num_lost - skipped
        figures[key] = (server, gateway, max(0, gaps) + component.num_skipped + component.num_malformed)
    rows: list[tuple[str, ...]] = []
    if any(map(any, figures.values())):
        rows = [(key, *map(_figure, places), _figure(sum(places))) for key, places in figures.items()]
    for output in report.outputs if report else ():  # of all components together
        if dropped := sum(loss.num_messages for loss in output.losses):
            name = html_text(output.output)
            rows.append((f"output {name}", NONE, _figure(dropped), NONE, _figure(dropped)))
    parts = [table(("lost messages", "server", "gateway", "here", "all"), rows), _NOTE] if rows else []
    parts += [f"<p class={level.value}>{text}</p>" for level, text in _causes(source, components)]
    return "".join(parts) or "<p class=good>nothing lost, dropped or skipped</p>"


def _figure(number: int) -> str:
    return f"<span class=bad>{number}</span>" if number else "0"


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


def _causes(source: DisplayedSource, components: Mapping[str, LiveComponent]) -> Iterator[tuple[Level, str]]:
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
            drops = html_text(counts_text(stream.losses), _MAX_CHARACTERS)
            yield Level.WAITING, f"dropped at {name}: {drops}"
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
            drops = html_text(counts_text(output.losses), _MAX_CHARACTERS)
            yield Level.WAITING, f"dropped at output {name}: {drops}"


def ignored_html(live: LiveData) -> str:
    """Say what was received and belongs to no source."""
    ignored = (
        (live.num_foreign, "of another program"),
        (live.num_beyond, "of more sources or keys than can be shown"),
        (live.num_defects, "because of a defect in this program"),
    )
    texts = [f"{counted(number, 'message')} {why}" for number, why in ignored if number]
    return f"<p class=waiting>left out: {', '.join(texts)}</p>" if texts else ""


MAX_ROWS: Final = 40
"""How many markers and how many tools of a source are shown, those first that are visible least often."""

_MAX_EVENT_CHARACTERS: Final = 200

_LEGEND: Final = (
    "<p class=legend>A name in <span class=bad>red</span> is missing in the newest frame. Bars: "
    "<span class=good>always visible</span>, <span class=waiting>90 % or more</span>, "
    "<span class=bad>less</span>.</p>"
)


def items_html(source: DisplayedSource) -> str:
    """Return the markers and tools of a source with their visibility over the last seconds."""
    tables = [
        _visibility_html(source.components[key], noun)
        for key, noun in (("6d", "tool"), ("3d", "marker"))
        if key in source.components
    ]
    texts = [_LEGEND, *tables] if tables else ["<p class=dim>no markers and no tools</p>"]
    return f"<section class=items><h3>{html_text(source.name)}</h3>{''.join(texts)}</section>"


def _visibility_html(component: LiveComponent, noun: str) -> str:
    shares, num_items = component.visible_shares, len(component.newest_items)
    if not len(shares):
        reason = ", no frames in the last 10 s" if num_items else ""
        return f"<p class=dim>{counted(num_items, noun)}{reason}</p>"
    is_visible = component.is_visible
    units, labels = component.description.units, component.description.labels
    rows = []
    for index in np.argsort(shares, kind="stable").tolist()[:MAX_ROWS]:
        name = html_text(labels[index])
        if component.is_stopped:
            name = f"<span class=dim>{name}</span>"
        elif not is_visible[index]:
            name = f"<span class=bad>{name}</span>"
        # Markers have an empty column, so that the bars of both tables align.
        error = ""
        if noun == "tool":
            value = float(component.newest_items["error"][index])
            number = f"{value:.3g}" if math.isfinite(value) else NONE
            error = f"{number} {html_text(units[index])}" if is_visible[index] else NONE
        share = float(shares[index])
        level = "good" if share == 1 else "waiting" if share >= 0.9 else "bad"
        bar = f"<span class=bar><i class={level} style=width:{100 * share:.0f}%></i></span>"
        rows.append((name, f"{bar}<span class=share>{share_text(share)}</span>", error))
    headings = (counted(num_items, noun), "visible, last 10 s", "error" if noun == "tool" else "")
    num_hidden = len(shares) - MAX_ROWS
    if num_hidden <= 0:
        return table(headings, rows)
    least = float(np.sort(shares)[MAX_ROWS])
    how = "always visible" if least == 1 else f"visible in at least {share_text(least)} of the frames"
    return f"{table(headings, rows)}<p class=dim>{counted(num_hidden, f'more {noun}')}, {how}</p>"


def events_html(source: DisplayedSource) -> str:
    """Return the newest events of a source, the newest one first."""
    rows = []
    for event in reversed([*source.events]):
        text = event.text
        description = html_text(text.description, _MAX_EVENT_CHARACTERS)
        rows.append((event_time_text(event.capture_utime), html_text(text.label), description))
    events = table(("captured", "event", ""), rows) if rows else "<p class=dim>no events yet</p>"
    return f"<section class=events><h3>{html_text(source.name)}</h3>{events}</section>"
