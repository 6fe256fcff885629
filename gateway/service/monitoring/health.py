"""The health check: every stream receives frames, every output is connected, and nothing is lost."""

import json
from collections.abc import Iterable, Iterator, Sequence
from http import HTTPStatus
from typing import Any, NamedTuple

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.logs.losses import Loss, last_minute_text, route_name
from gateway.logs.safe_text import safe_json
from gateway.outputs.contract import Output, OutputHealth
from gateway.service.gateway import Gateway
from gateway.service.monitoring.http_pages import Page
from gateway.service.source import Source
from gateway.stream.process_clock import running_clock
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus
from gateway.stream.status_text import source_text, stream_text, unusable_frames


class _Route(NamedTuple):
    """What was lost of a source: in one stream, before any output, or on one output."""

    source: str
    stream: str | None
    output: str | None
    losses: Sequence[Loss]

    @property
    def name(self) -> str:
        """The name in texts."""
        return route_name(self.source, self.stream, self.output)


def health_page(gateway: Gateway, process_problems: Sequence[str] = ()) -> Page:
    """Return the page /healthz: JSON with status 200, or 503 if a stream or an output has a problem.

    ``process_problems`` are those of the whole process, see ProcessLimits. If something was lost in the last
    minute, the gateway is degraded, which is still 200.
    """
    now_s = running_clock().time()  # a stop of this process does not make the newest frames older
    streams = [
        _stream_health(source, stream.settings, stream.status, stream.frame_rate.rate_hz, now_s)
        for source in gateway.sources
        for stream in source.streams
    ]
    outputs = [_output_health(output) for output in gateway.outputs]
    problems = [
        *(f"gateway: {problem}" for problem in process_problems),
        *(f"{each['source']} ({each['stream']}): {each['problem']}" for each in streams if each["problem"]),
        *(f"{each['output']}: {each['problem']}" for each in outputs if each["problem"]),
    ]
    routes = list(_losses(gateway))
    losses = [f"{route.name}: {text}" for route in routes if (text := last_minute_text(route.losses))]
    body = {
        "status": "unhealthy" if problems else "degraded" if losses else "healthy",
        "healthy": not problems,
        "reasons": [*problems, *losses],
        "process": list(process_problems),
        "streams": streams,
        "outputs": outputs,
        "losses": [loss for route in routes for loss in _losses_json(route)],
    }
    status = HTTPStatus.SERVICE_UNAVAILABLE if problems else HTTPStatus.OK
    return Page(
        status, "application/json", safe_json(json.dumps(body, ensure_ascii=False, indent=2)).encode() + b"\n"
    )


def _stream_health(
    source: Source, stream: StreamSettings, status: StreamStatus, rate_hz: float, now_s: float
) -> dict[str, Any]:
    age_s = None if status.last_frame_s is None else now_s - status.last_frame_s
    return {
        "source": source.name,
        "stream": status.components,
        "server": f"{source.settings.host}:{source.settings.port}",
        "state": status.state.value,
        "session": status.session,
        "frames": status.frames_in,
        "frame_rate_hz": round(rate_hz, 3),
        "lag_s": round(status.lag_s, 6),
        "last_frame_age_s": age_s,
        "limitations": list(status.limitations),
        "problem": _stream_problem(source, stream, status, age_s),
    }


def _output_health(output: Output) -> dict[str, str]:
    health = output.health()
    return {"output": output.name, "problem": "" if health.connected else health.problem}


def _losses(gateway: Gateway) -> Iterator[_Route]:
    """Yield what each stream lost before any output, and what each source lost on each output."""
    for source in gateway.sources:
        for status in source.statuses:
            yield _Route(source.name, status.components, None, status.losses.report())
        for output, output_status in source.fan_out.outputs:
            yield _Route(source.name, None, output.name, output_status.losses)


def _losses_json(route: _Route) -> list[dict[str, Any]]:
    names = {"source": route.source, "stream": route.stream, "output": route.output}
    return [names | loss._asdict() | {"age_s": round(loss.age_s, 1)} for loss in route.losses]


def _stream_problem(source: Source, stream: StreamSettings, status: StreamStatus, age_s: float | None) -> str:
    """Return what is wrong with a stream and what to check; "" if frames arrive or none are needed."""
    max_age_s = source.settings.stall_timeout_s
    problem = unusable_frames(status, max_age_s)
    if problem:
        return problem
    if age_s is not None and age_s < max_age_s:
        return ""
    silence = "no frame so far" if age_s is None else f"no frame for {age_s:.1f} s (limit {max_age_s:g} s)"
    if _needs_no_frames(source, stream, status.state):
        return ""
    if status.state is StreamState.IDLE:
        return f"{silence}: {source.settings.host} is connected but sends nothing; is a measurement running?"
    reason = status.last_error or f"connecting to {source.settings.host}:{source.settings.port}"
    return f"{silence}: {reason}"


def _needs_no_frames(source: Source, stream: StreamSettings, state: StreamState) -> bool:
    match state:
        case StreamState.NO_MEASUREMENT:
            return True
        case StreamState.IDLE | StreamState.STREAMING if stream.has_only_events:
            return True
        case StreamState.IDLE:
            return stream.on_demand and not source.fan_out.has_subscribers(stream.components)
        case _:
            return False


def status_lines(gateway: Gateway) -> list[str]:
    """Return a text for each source, for each output that cannot send, and for what an output loses."""
    outputs = ((output.name, output.health()) for output in gateway.outputs)
    losses = (
        (f"{source.name} to {output.name}", status.losses)
        for source in gateway.sources
        for output, status in source.fan_out.outputs
    )
    return [
        *(source_line(source.settings, source.rated_statuses) for source in gateway.sources),
        *output_lines(outputs),
        *loss_lines(losses),
    ]


def source_line(source: SourceSettings, streams: Sequence[tuple[StreamStatus, float]]) -> str:
    """Return the status of a source, such as "lab: streaming 200.0 Hz".

    ``streams`` are pairs of a status and a frame rate in Hz. If their texts differ, the components of each
    stream precede its text.
    """
    server = f"{source.host}:{source.port}"
    texts = []
    for status, rate_hz in streams:
        problem = unusable_frames(status, source.stall_timeout_s)
        text = problem or stream_text(status.state, server, rate_hz, status.tries)
        lost = last_minute_text(status.losses.report())
        texts.append((status.components, f"{text}, {lost}" if lost else text))
    return f"{source.name}: {source_text(texts)}"


def output_lines(outputs: Iterable[tuple[str, OutputHealth]]) -> list[str]:
    """Return a text for each output that cannot send; ``outputs`` are pairs of a name and its health."""
    return [f"{name}: {health.problem}" for name, health in outputs if not health.connected]


def loss_lines(losses: Iterable[tuple[str, Sequence[Loss]]]) -> list[str]:
    """Return a text for each output that lost something in the last minute.

    ``losses`` are pairs of the route, such as "lab to zenoh", and what was lost on it.
    """
    return [f"{route}: {text}" for route, lost in losses if (text := last_minute_text(lost))]
