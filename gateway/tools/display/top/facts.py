"""What is known about a source, from what its gateway publishes: values without numpy, for tables and JSON.

``source_facts`` returns all of it with the names of ``top --json``. What the status says is in
``source.report``.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from gateway.client.sources import POSE, ReceivedSeries
from gateway.messages.descriptions.labels import describe
from gateway.messages.source_report import Level, SourceReport, State
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.runtime.safe_text import safe_text
from gateway.tools.display.live import DisplayedSource, LiveComponent
from gateway.tools.display.statistics import Percentiles

_MAX_LABEL: Final = 64
"""How much is shown of a marker's or tool's label, and of its unit."""


class SequenceFacts(NamedTuple):
    """What the numbers of the messages show, of one key or of several together.

    ``num_refilled`` is None unless gaps are filled; then, ``num_lost`` counts what could not be.
    """

    num_messages: int
    num_lost: int
    num_gaps: int
    num_restarts: int
    has_two_gateways: bool
    num_refilled: int | None


@dataclass(frozen=True, slots=True)
class ComponentFacts:
    """One component. What has not come so far has no messages in ``sequence``. Tool poses are together: 6d/*.

    ``to_gateway`` is the latency from the capture to the gateway, ``to_here`` the one from there to here.
    """

    component: str
    rate_hz: float | None
    announced_rate_hz: float | None
    sequence: SequenceFacts
    to_gateway: Percentiles | None = None
    to_here: Percentiles | None = None
    num_items: int | None = None
    num_visible: int | None = None
    age_s: float | None = None
    is_stopped: bool = False
    num_skipped: int = 0
    num_malformed: int = 0


@dataclass(frozen=True, slots=True)
class ItemFacts:
    """A marker or a tool. ``visible_share`` is over the last 10 s; markers have no ``error``."""

    label: str
    visible_share: float | None
    is_visible: bool
    x: float | None
    y: float | None
    z: float | None
    unit: str
    error: float | None


@dataclass(frozen=True, slots=True)
class LossFacts:
    """What was lost for one cause, since the start of ``where``."""

    where: str
    cause: str
    num_messages: int
    num_frames: int | None


@dataclass(frozen=True, slots=True)
class EventFacts:
    """An event, and when it was captured: µs since the Unix epoch, on the gateway's clock."""

    capture_utime: int
    label: str
    parameters: str


def state(source: DisplayedSource) -> State:
    """Return the state of a source, in the words of the status line."""
    if source.is_silent:
        age_s = source.status_age_s
        since = "yet" if age_s is None else f"for {age_s:.0f} s"
        return State(Level.BAD, f"no status of its gateway {since}; is it running?")
    if source.report is None:
        return State(Level.WAITING, "waiting for the status of its gateway")
    level, text = source.report.level, safe_text(source.report.text) or "its gateway reports no stream"
    stopped = [key for key, each in [*source.components.items()] if each.is_stopped]
    if stopped and level is not Level.BAD:
        in_order = [each.key for each in WIRE_ORDER if each.key in stopped]
        return State(Level.BAD, f"{text}; stopped: {' '.join(in_order)}")
    return State(level, text)


def components(source: DisplayedSource) -> list[ComponentFacts]:
    """Return the components that have come or that the streams request, in the order of frames."""
    wanted = {*source.components, *(source.report.components if source.report else ())}
    found = [_component(source, each) for each in WIRE_ORDER if each.key in wanted]
    poses = [series for series in source.series if series.key.startswith(POSE)]
    if poses:
        found.append(ComponentFacts(f"{POSE}*", None, None, _sequence_facts(poses), num_items=len(poses)))
    return found


def _component(source: DisplayedSource, kind: ComponentType) -> ComponentFacts:
    component = source.components.get(kind.key) or LiveComponent(kind)
    series = source.series_by_key.get(kind.key)
    has_come = component.newest_head is not None
    announced_hz = describe(kind, source.newest_parameters, len(component.newest_items)).rate_hz
    can_be_seen = kind in {ComponentType.MARKERS, ComponentType.TOOLS} and has_come
    return ComponentFacts(
        kind.key,
        0.0 if component.is_stopped else component.rate_hz,
        announced_hz if announced_hz is not None and math.isfinite(announced_hz) else None,
        _sequence_facts([] if series is None else [series]),
        to_gateway=component.latency.to_gateway,
        to_here=component.latency.to_here,
        num_items=len(component.newest_items) if has_come else None,
        num_visible=int(component.is_visible.sum()) if can_be_seen else None,
        age_s=component.age_s,
        is_stopped=component.is_stopped,
        num_skipped=component.num_skipped,
        num_malformed=component.num_malformed,
    )


def _sequence_facts(series: Sequence[ReceivedSeries]) -> SequenceFacts:
    checks = [each.check for each in series]
    refilled = [each.completion.num_refilled for each in series if each.completion is not None]
    return SequenceFacts(
        num_messages=sum(each.num_messages for each in series),
        num_lost=sum(check.num_lost for check in checks),
        num_gaps=sum(check.num_gaps for check in checks),
        num_restarts=max((check.num_restarts for check in checks), default=0),
        has_two_gateways=any(check.has_two_publishers for check in checks),
        num_refilled=sum(refilled) if refilled else None,
    )


def refill_problems(source: DisplayedSource) -> list[str]:
    """Return why gaps are not filled although they should be, each reason once."""
    completions = [series.completion for series in source.series if series.completion is not None]
    return [*dict.fromkeys(safe_text(each.problem) for each in completions if each.problem)]


def has_two_gateways(source: DisplayedSource) -> bool:
    """Whether two gateways publish sources of this name, as far as the numbers of the messages show."""
    return any(series.check.has_two_publishers for series in source.series)


def items(source: DisplayedSource, kind: ComponentType) -> list[ItemFacts]:
    """Return the markers or the tools, in the order of the server."""
    component = source.components.get(kind.key)
    if component is None:
        return []
    newest = component.newest_items
    shares = component.visible_shares.tolist() or [None] * len(newest)
    errors = newest["error"].tolist() if "error" in (newest.dtype.names or ()) else [None] * len(newest)
    columns = zip(
        component.description.labels,
        component.description.units,
        shares,
        component.is_visible.tolist(),
        *(newest[name].tolist() for name in "xyz"),
        errors,
        strict=True,
    )
    found = []
    for label, unit, share, is_seen, *values in columns:
        x, y, z, error = values if is_seen else (None, None, None, None)
        name, unit_name = safe_text(label, _MAX_LABEL), safe_text(unit, _MAX_LABEL)
        found.append(ItemFacts(name, share, is_seen, x, y, z, unit_name, error))
    return found


def losses(source: DisplayedSource) -> list[LossFacts]:
    """Return what was lost: before the outputs, on each of them, and on the way here."""
    found = []
    if source.report is not None:
        routes = [(f"stream {each.components}", each.losses) for each in source.report.streams]
        routes += [(f"output {each.output}", each.losses) for each in source.report.outputs]
        found = [LossFacts(where, *loss) for where, losses in routes for loss in losses]
    checks = [series.check for series in source.series]
    here = {
        "missing in the sequence of messages": sum(check.num_lost for check in checks),
        "repeated": sum(check.num_repeated for check in checks),
        "not decoded: too many waited": source.num_skipped,
        "malformed": sum(each.num_malformed for each in [*source.components.values()]),
        "unreadable parameters or status": source.num_unreadable,
    }
    return found + [LossFacts("received here", cause, count, None) for cause, count in here.items() if count]


def events(source: DisplayedSource) -> list[EventFacts]:
    """Return the last events, the newest one first."""
    return [
        EventFacts(event.capture_utime, safe_text(event.text.label), safe_text(event.text.description))
        for event in reversed(source.events)
    ]


_COMPONENT_FIELDS: Final = ("num_items", "num_visible", "age_s", "is_stopped", "num_skipped", "num_malformed")
_STREAM_FIELDS: Final = (
    *("components", "state", "problem", "session", "byte_order", "rate", "frame_rate_hz", "lag_ms"),
    *("num_reconnects", "num_restarts", "has_clock", "clock_drift_ppm", "clock_uncertainty_us"),
    *("limitations", "last_error", "last_error_utime"),
)
_LEVELS: Final = {Level.GOOD: "ok", Level.WAITING: "warning", Level.BAD: "error"}
_OUTPUT_FIELDS: Final = ("output", "is_connected", "problem", "messages", "queries")


def source_facts(source: DisplayedSource) -> dict[str, Any]:
    """Return everything about a source, for JSON."""
    found, report = state(source), source.report or SourceReport(source.name)
    return {
        "source": safe_text(source.name),
        "server": report.server,
        "host": report.host,
        "gateway_version": report.version,
        "routers": None if source.routers is None else [*source.routers],
        "state": found.text,
        "level": _LEVELS[found.level],
        "status_age_s": source.status_age_s,
        "age_s": source.age_s,
        "is_stopped": source.is_stopped,
        "has_two_gateways": has_two_gateways(source),
        "refill_problems": refill_problems(source),
        "parameters_version": source.parameters_version,
        "components": [_component_fields(each) for each in components(source)],
        "markers": items(source, ComponentType.MARKERS),
        "tools": items(source, ComponentType.TOOLS),
        "streams": [_fields(stream, _STREAM_FIELDS) for stream in report.streams],
        "losses": losses(source),
        "outputs": [_fields(output, _OUTPUT_FIELDS) for output in report.outputs],
        "events": events(source),
    }


def _component_fields(facts: ComponentFacts) -> dict[str, Any]:
    to_gateway_p50_ms, to_gateway_p99_ms = facts.to_gateway or (None, None)
    to_here_p50_ms, to_here_p99_ms = facts.to_here or (None, None)
    return {
        **_fields(facts, ("component", "rate_hz", "announced_rate_hz")),
        **facts.sequence._asdict(),
        "capture_to_gateway_p50_ms": to_gateway_p50_ms,
        "capture_to_gateway_p99_ms": to_gateway_p99_ms,
        "gateway_to_here_p50_ms": to_here_p50_ms,
        "gateway_to_here_p99_ms": to_here_p99_ms,
        **_fields(facts, _COMPONENT_FIELDS),
    }


def _fields(report: object, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(report, name) for name in names}
