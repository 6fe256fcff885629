"""The pages of ``top``: a table each, made from the facts about all sources."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Final, NamedTuple

from gateway.messages.source_report import Level, OutputReport
from gateway.rtc3d.components import ComponentType
from gateway.runtime.safe_text import safe_text
from gateway.tools.display.live import SLOW_SHARE, DisplayedSource
from gateway.tools.display.statistics import Percentiles, visible_percent
from gateway.tools.display.terminal import Style
from gateway.tools.display.top import facts
from gateway.tools.display.top.table import (
    Cell,
    Order,
    Row,
    TopColumn,
    TopSection,
    TopTable,
    number_cell,
    text_cell,
)

TWO_GATEWAYS: Final = (
    "two gateways publish a source of this name, so lost messages are not counted exactly: give one of them "
    "another name"
)
_LEVEL_STYLES: Final = {Level.GOOD: Style.GOOD, Level.WAITING: Style.WARNING, Level.BAD: Style.BAD}
_MAX_NAME: Final = 40
_SELDOM_SHARE: Final = 0.9
"""A marker or tool that is visible in a smaller share of the frames is worth a look."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


class TopPage(NamedTuple):
    """A page: its name, and what it shows of all sources."""

    name: str
    table: Callable[[Sequence[DisplayedSource]], TopTable]


def overview(sources: Sequence[DisplayedSource]) -> TopTable:
    """Each source with its state, and a line for each of its components."""
    is_complete = any(series.completion for source in sources for series in source.series)
    columns = (
        TopColumn("component"),
        TopColumn("Hz", is_number=True, width=6),
        TopColumn("announced", is_number=True, rank=1),
        TopColumn("lost", is_number=True),
        *([TopColumn("refilled", is_number=True)] if is_complete else []),
        TopColumn("gaps", is_number=True, rank=6),
        TopColumn("restarts", is_number=True, rank=7),
        TopColumn("→gateway ms", is_number=True, rank=2),
        TopColumn("→here ms", is_number=True, rank=2),
        TopColumn("items", is_number=True, rank=5),
        TopColumn("visible", is_number=True, rank=3),
        TopColumn("age s", is_number=True, rank=4),
        TopColumn("note"),
    )
    sections = []
    for source in sources:
        state = facts.state(source)
        way = f", by {' → '.join(source.routers)}" if source.routers else ""
        heading = [(f"{_name(source)}: {state.text}{way}", _LEVEL_STYLES[state.level])]
        if facts.has_two_gateways(source):
            heading.append((TWO_GATEWAYS, Style.BAD))
        heading += [(f"gaps are not filled: {text}", Style.WARNING) for text in facts.refill_problems(source)]
        rows = [_component_row(each, is_complete=is_complete) for each in facts.components(source)]
        sections.append(TopSection(rows, heading + _output_problems(source)))
    return TopTable(columns, sections, "no source so far")


def _component_row(component: facts.ComponentFacts, *, is_complete: bool) -> Row:
    sequence = component.sequence
    note, style = "", Style.PLAIN
    if component.is_stopped:
        note, style = "stopped", Style.BAD
    elif sequence.has_two_gateways:
        note, style = "two gateways", Style.BAD
    elif component.num_malformed:
        note, style = f"{component.num_malformed} malformed", Style.WARNING
    elif component.num_skipped:
        note, style = f"{component.num_skipped} not decoded here", Style.WARNING
    elif not sequence.num_messages:
        note, style = "none so far", Style.FAINT
    rate_hz, announced_hz = component.rate_hz, component.announced_rate_hz
    has_rates = rate_hz is not None and announced_hz is not None and sequence.num_messages > 0
    is_slow = has_rates and (rate_hz or 0.0) < SLOW_SHARE * (announced_hz or 0.0)
    is_missing = component.num_visible is not None and component.num_visible < (component.num_items or 0)
    lost_style = Style.BAD if sequence.num_lost else Style.PLAIN
    return (
        text_cell(component.component),
        number_cell(rate_hz, 1, style if style is Style.BAD else _warning_if(is_slow)),
        number_cell(announced_hz, 1),
        number_cell(sequence.num_lost, 0, lost_style),
        *([number_cell(sequence.num_refilled)] if is_complete else []),
        number_cell(sequence.num_gaps, 0, lost_style),
        number_cell(sequence.num_restarts, 0, _warning_if(sequence.num_restarts > 0)),
        _latency_cell(component.to_gateway),
        _latency_cell(component.to_here),
        number_cell(component.num_items),
        number_cell(component.num_visible, 0, _warning_if(is_missing)),
        number_cell(component.age_s, 1, style if style is Style.BAD else Style.PLAIN),
        text_cell(note, style),
    )


def _latency_cell(latency: Percentiles | None) -> Cell:
    if latency is None:
        return Cell("")
    text = f"{number_cell(latency.p50_ms, 1).text}/{number_cell(latency.p99_ms, 1).text}"
    return Cell(text, Style.PLAIN, latency.p99_ms)


def items(sources: Sequence[DisplayedSource], kind: ComponentType, noun: str) -> TopTable:
    """How often each marker or tool was visible, the error of tools, and where they are."""
    has_error = kind is ComponentType.TOOLS
    columns = (
        TopColumn(noun),
        TopColumn("visible in 10 s", is_number=True),
        TopColumn("now"),
        *([TopColumn("error", is_number=True)] if has_error else []),
        *(TopColumn(axis, is_number=True, rank=2, width=7) for axis in "xyz"),
        TopColumn("unit", rank=3),
        TopColumn("source", rank=1),
    )
    rows = [
        (
            text_cell(item.label, Style.PLAIN if item.is_visible else Style.BAD),
            _share_cell(item.visible_share),
            text_cell("visible") if item.is_visible else text_cell("missing", Style.BAD),
            *([number_cell(item.error, 3)] if has_error else []),
            *(number_cell(value, 1) for value in (item.x, item.y, item.z)),
            text_cell(item.unit, Style.FAINT),
            text_cell(_name(source)),
        )
        for source in sources
        for item in facts.items(source, kind)
    ]
    return TopTable(columns, [TopSection(rows)], f"no {noun}s so far", Order("visible in 10 s"))


def _share_cell(share: float | None) -> Cell:
    if share is None:
        return Cell("")
    style = Style.BAD if share < _SELDOM_SHARE else _warning_if(share < 1)
    return Cell(f"{visible_percent(share):.1f} %", style, share)


def server(sources: Sequence[DisplayedSource]) -> TopTable:
    """The streams of each source, and the clock of its server."""
    columns = (
        TopColumn("stream"),
        TopColumn("state"),
        TopColumn("Hz", is_number=True, width=6),
        TopColumn("session", is_number=True, rank=4),
        TopColumn("reconnects", is_number=True, rank=3),
        TopColumn("restarts", is_number=True, rank=6),
        TopColumn("byte order", rank=7),
        TopColumn("rate", rank=5),
        TopColumn("late ms", is_number=True, rank=1),
        TopColumn("drift ppm", is_number=True, rank=2),
        TopColumn("uncertainty µs", is_number=True, rank=2),
    )
    sections = []
    for source in sources:
        report = source.report
        where = f" from {report.server} by {report.host} (version {report.version})" if report else ""
        rows, notes = [], []
        for stream in report.streams if report else ():
            rows.append(
                (
                    text_cell(stream.components),
                    text_cell(stream.state, Style.GOOD if stream.state == "streaming" else Style.WARNING),
                    number_cell(stream.frame_rate_hz, 1),
                    number_cell(stream.session),
                    number_cell(stream.num_reconnects),
                    number_cell(stream.num_restarts),
                    text_cell(stream.byte_order),
                    text_cell(stream.rate),
                    number_cell(stream.lag_ms, 1),
                    number_cell(stream.clock_drift_ppm if stream.has_clock else None, 2),
                    number_cell(stream.clock_uncertainty_us if stream.has_clock else None, 1),
                )
            )
            found = [(stream.problem, Style.BAD)] if stream.problem else []
            found += [(text, Style.WARNING) for text in stream.limitations]
            if stream.last_error:
                error = f"last error, {event_time(stream.last_error_utime)}: {stream.last_error}"
                found.append((error, Style.FAINT))
            if not stream.has_clock and stream.state == "streaming":
                found.append(("its time stamps are no clock", Style.WARNING))
            notes += [(f"{stream.components}: {text}", style) for text, style in found]
        style = _LEVEL_STYLES[facts.state(source).level]
        sections.append(TopSection(rows, [(f"{_name(source)}{where}", style)], notes))
    return TopTable(columns, sections, "no source so far")


def drops(sources: Sequence[DisplayedSource]) -> TopTable:
    """What was lost, where, and why."""
    columns = (
        TopColumn("source", rank=2),
        TopColumn("where"),
        TopColumn("cause"),
        TopColumn("messages", is_number=True),
        TopColumn("frames", is_number=True, rank=1),
    )
    rows = [
        (
            text_cell(_name(source)),
            text_cell(loss.where),
            text_cell(loss.cause, Style.BAD),
            number_cell(loss.num_messages),
            number_cell(loss.num_frames),
        )
        for source in sources
        for loss in facts.losses(source)
    ]
    return TopTable(columns, [TopSection(rows)], "nothing was lost")


def outputs(sources: Sequence[DisplayedSource]) -> TopTable:
    """The outputs of the gateways: whether they are connected, and what they have sent."""
    columns = (
        TopColumn("source"),
        TopColumn("output"),
        TopColumn("state"),
        TopColumn("messages", is_number=True),
        TopColumn("of which", rank=1),
    )
    rows, notes = [], []
    for source in sources:
        for output in _outputs(source):
            state = "connected" if output.is_connected else "not connected"
            is_fine = output.is_connected and not output.problem
            rows.append(
                (
                    text_cell(_name(source)),
                    text_cell(output.output),
                    text_cell(state, Style.GOOD if is_fine else Style.BAD),
                    number_cell(sum(output.messages.values())),
                    text_cell(", ".join(f"{name} {count}" for name, count in output.messages.items())),
                )
            )
        notes += _output_problems(source)
    return TopTable(columns, [TopSection(rows, (), notes)], "no output so far")


def questions(sources: Sequence[DisplayedSource]) -> TopTable:
    """How many queries of peers the gateways have answered, by result."""
    columns = (
        TopColumn("source"),
        TopColumn("output"),
        TopColumn("result"),
        TopColumn("queries", is_number=True),
    )
    rows = [
        (
            text_cell(_name(source)),
            text_cell(output.output),
            text_cell(result, Style.GOOD if result == "ok" else Style.WARNING),
            number_cell(count),
        )
        for source in sources
        for output in _outputs(source)
        for result, count in output.queries.items()
    ]
    return TopTable(columns, [TopSection(rows)], "nobody has asked anything so far")


def events(sources: Sequence[DisplayedSource]) -> TopTable:
    """The last events of each source, the newest one first."""
    columns = (
        TopColumn("time"),
        TopColumn("event"),
        TopColumn("parameters", rank=2),
        TopColumn("source", rank=1),
    )
    found = [(source, event) for source in sources for event in facts.events(source)]
    found.sort(key=lambda each: each[1].capture_utime, reverse=True)
    rows = [
        (
            Cell(event_time(event.capture_utime), Style.PLAIN, event.capture_utime),
            text_cell(event.label),
            text_cell(event.parameters),
            text_cell(_name(source)),
        )
        for source, event in found
    ]
    return TopTable(columns, [TopSection(rows)], "no events so far")


PAGES: Final = (
    TopPage("overview", overview),
    TopPage("markers", partial(items, kind=ComponentType.MARKERS, noun="marker")),
    TopPage("tools", partial(items, kind=ComponentType.TOOLS, noun="tool")),
    TopPage("server", server),
    TopPage("drops", drops),
    TopPage("outputs", outputs),
    TopPage("questions", questions),
    TopPage("events", events),
)
"""In the order of the keys 1 to 8."""


def event_time(utime: int) -> str:
    """Return a time, in µs since the Unix epoch, as local time; "?" if no calendar has it."""
    try:
        local = (_EPOCH + timedelta(microseconds=utime)).astimezone()
    except (OverflowError, ValueError, OSError):
        return "?"
    return local.strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]


def _output_problems(source: DisplayedSource) -> list[tuple[str, Style]]:
    problems = ((each.output, each.problem) for each in _outputs(source) if each.problem)
    return [(f"{_name(source)} to {output}: {problem}", Style.BAD) for output, problem in problems]


def _outputs(source: DisplayedSource) -> Sequence[OutputReport]:
    return source.report.outputs if source.report else ()


def _name(source: DisplayedSource) -> str:
    return safe_text(source.name, _MAX_NAME)


def _warning_if(is_true: bool) -> Style:
    return Style.WARNING if is_true else Style.PLAIN
