"""What is known about a source, from what its gateway publishes: values without numpy, for tables and JSON.

The names of the fields are those of ``top --json``. What the status says is in ``source.report``.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from gateway.client.series import POSE
from gateway.descriptions.labels import describe
from gateway.display.live.component import LiveComponent, Percentiles
from gateway.display.live.live_data import LiveSource
from gateway.logs.safe_text import safe_text
from gateway.messages.source_report import Level, SourceReport
from gateway.rtc3d.components import WIRE_ORDER, ComponentType

_MAX_LABEL: Final = 64
"""How much is shown of a marker's or tool's label, and of its unit."""


@dataclass(frozen=True, slots=True)
class StateFacts:
    """The state of a source. ``level`` is ok, warning or error."""

    text: str
    level: str


@dataclass(frozen=True, slots=True)
class ComponentFacts:
    """One component. What has not come so far has ``num_messages`` 0. Tool poses are together: 6d/*."""

    component: str
    rate_hz: float | None
    announced_rate_hz: float | None
    num_messages: int
    num_lost: int
    num_gaps: int
    num_restarts: int
    has_two_gateways: bool
    capture_to_gateway_p50_ms: float | None
    capture_to_gateway_p99_ms: float | None
    gateway_to_here_p50_ms: float | None
    gateway_to_here_p99_ms: float | None
    num_items: int | None
    num_visible: int | None
    age_s: float | None
    is_stopped: bool
    num_skipped: int
    num_malformed: int


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


def state(source: LiveSource) -> StateFacts:
    """Return the state of a source, in the words of the status line."""
    if source.is_silent:
        age_s = source.status_age_s
        since = "yet" if age_s is None else f"for {age_s:.0f} s"
        return StateFacts(f"no status of its gateway {since}; is it running?", "error")
    if source.report is None:
        return StateFacts("waiting for the status of its gateway", "warning")
    text = safe_text(source.report.text) or "its gateway reports no stream"
    stopped = [each.key for each in WIRE_ORDER if _is_stopped(source, each)]
    levels = {stream.level for stream in source.report.streams}
    if Level.BAD in levels:
        return StateFacts(text, "error")
    if stopped:
        return StateFacts(f"{text}; stopped: {' '.join(stopped)}", "error")
    return StateFacts(text, "ok" if levels == {Level.GOOD} else "warning")


def _is_stopped(source: LiveSource, kind: ComponentType) -> bool:
    component = source.components.get(kind.key)
    return component is not None and component.is_stopped


def components(source: LiveSource) -> list[ComponentFacts]:
    """Return the components that have come or that the streams request, in the order of frames."""
    wanted = {*source.components, *(source.report.components if source.report else ())}
    found = [_component(source, each) for each in WIRE_ORDER if each.key in wanted]
    poses = [series for series in source.series if series.key.startswith(POSE)]
    return [*found, _poses(poses)] if poses else found


def _component(source: LiveSource, kind: ComponentType) -> ComponentFacts:
    component = source.components.get(kind.key) or LiveComponent(kind)
    series = source.series_by_key.get(kind.key)
    has_come = component.newest_head is not None
    announced = describe(kind, source.newest_parameters, len(component.newest_items)).rate_hz
    can_be_seen = kind in {ComponentType.MARKERS, ComponentType.TOOLS} and has_come
    to_gateway, to_here = component.latency.to_gateway, component.latency.to_here
    return ComponentFacts(
        component=kind.key,
        rate_hz=0.0 if component.is_stopped else component.rate_hz,
        announced_rate_hz=_finite(announced),
        num_messages=0 if series is None else series.num_messages,
        num_lost=0 if series is None else series.check.num_lost,
        num_gaps=0 if series is None else series.check.num_gaps,
        num_restarts=0 if series is None else series.check.num_restarts,
        has_two_gateways=series is not None and series.check.has_two_publishers,
        capture_to_gateway_p50_ms=_p50_ms(to_gateway),
        capture_to_gateway_p99_ms=_p99_ms(to_gateway),
        gateway_to_here_p50_ms=_p50_ms(to_here),
        gateway_to_here_p99_ms=_p99_ms(to_here),
        num_items=len(component.newest_items) if has_come else None,
        num_visible=int(component.is_visible.sum()) if can_be_seen else None,
        age_s=component.age_s,
        is_stopped=component.is_stopped,
        num_skipped=component.num_skipped,
        num_malformed=component.num_malformed,
    )


def _poses(series: Iterable[Any]) -> ComponentFacts:
    poses = [*series]
    checks = [each.check for each in poses]
    return ComponentFacts(
        component=f"{POSE}*",
        rate_hz=None,
        announced_rate_hz=None,
        num_messages=sum(each.num_messages for each in poses),
        num_lost=sum(check.num_lost for check in checks),
        num_gaps=sum(check.num_gaps for check in checks),
        num_restarts=max(check.num_restarts for check in checks),
        has_two_gateways=any(check.has_two_publishers for check in checks),
        capture_to_gateway_p50_ms=None,
        capture_to_gateway_p99_ms=None,
        gateway_to_here_p50_ms=None,
        gateway_to_here_p99_ms=None,
        num_items=len(poses),
        num_visible=None,
        age_s=None,
        is_stopped=False,
        num_skipped=0,
        num_malformed=0,
    )


def has_two_gateways(source: LiveSource) -> bool:
    """Whether two gateways publish sources of this name, as far as the numbers of the messages show."""
    return any(series.check.has_two_publishers for series in source.series)


def markers(source: LiveSource) -> list[ItemFacts]:
    """Return the markers, in the order of the server."""
    return _items(source.components.get("3d"))


def tools(source: LiveSource) -> list[ItemFacts]:
    """Return the tools, in the order of the server."""
    return _items(source.components.get("6d"))


def _items(component: LiveComponent | None) -> list[ItemFacts]:
    if component is None:
        return []
    items = component.newest_items
    shares = component.visible_shares.tolist() or [None] * len(items)
    errors = items["error"].tolist() if "error" in (items.dtype.names or ()) else [None] * len(items)
    columns = zip(
        component.description.labels,
        component.description.units,
        shares,
        component.is_visible.tolist(),
        *(items[name].tolist() for name in "xyz"),
        errors,
        strict=True,
    )
    return [
        ItemFacts(
            safe_text(label, _MAX_LABEL),
            share,
            is_seen,
            x if is_seen else None,
            y if is_seen else None,
            z if is_seen else None,
            safe_text(unit, _MAX_LABEL),
            error if is_seen else None,
        )
        for label, unit, share, is_seen, x, y, z, error in columns
    ]


def losses(source: LiveSource) -> list[LossFacts]:
    """Return what was lost: before the outputs, on each of them, and on the way here."""
    found = []
    if source.report is not None:
        routes = [(f"stream {each.components}", each.losses) for each in source.report.streams]
        routes += [(f"output {each.output}", each.losses) for each in source.report.outputs]
        found = [LossFacts(where, *loss) for where, losses in routes for loss in losses]
    checks = [(series.key, series.check) for series in source.series]
    here = {
        "missing in the sequence of messages": sum(check.num_lost for _, check in checks),
        "repeated": sum(check.num_repeated for _, check in checks),
        "not decoded: too many waited": source.num_skipped,
        "malformed": sum(each.num_malformed for each in [*source.components.values()]),
        "unreadable parameters or status": source.num_unreadable,
    }
    return found + [LossFacts("received here", cause, count, None) for cause, count in here.items() if count]


def events(source: LiveSource) -> list[EventFacts]:
    """Return the last events, the newest one first."""
    return [
        EventFacts(event.capture_utime, safe_text(event.text.label), safe_text(event.text.description))
        for event in reversed(source.events)
    ]


_STREAM_FIELDS: Final = (
    "components",
    "state",
    "problem",
    "session",
    "byte_order",
    "rate",
    "frame_rate_hz",
    "lag_ms",
    "num_reconnects",
    "num_restarts",
    "has_clock",
    "clock_drift_ppm",
    "clock_uncertainty_us",
    "limitations",
    "last_error",
    "last_error_utime",
)
_OUTPUT_FIELDS: Final = ("output", "is_connected", "problem", "messages", "queries")


def source_facts(source: LiveSource) -> dict[str, Any]:
    """Return everything about a source, for JSON."""
    found, report = state(source), source.report or SourceReport(source.name)
    return {
        "source": safe_text(source.name),
        "server": report.server,
        "host": report.host,
        "gateway_version": report.version,
        "state": found.text,
        "level": found.level,
        "status_age_s": source.status_age_s,
        "age_s": source.age_s,
        "is_stopped": source.is_stopped,
        "has_two_gateways": has_two_gateways(source),
        "parameters_version": source.parameters_version,
        "components": components(source),
        "markers": markers(source),
        "tools": tools(source),
        "streams": [_fields(stream, _STREAM_FIELDS) for stream in report.streams],
        "losses": losses(source),
        "outputs": [_fields(output, _OUTPUT_FIELDS) for output in report.outputs],
        "events": events(source),
    }


def _fields(report: object, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(report, name) for name in names}


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _p50_ms(latency: Percentiles | None) -> float | None:
    return None if latency is None else latency.p50_ms


def _p99_ms(latency: Percentiles | None) -> float | None:
    return None if latency is None else latency.p99_ms
