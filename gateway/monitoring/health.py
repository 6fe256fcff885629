"""The health check: every stream receives frames and every output is connected."""

import json
from http import HTTPStatus
from typing import Any, Final

from gateway.config.settings import StreamSettings
from gateway.gateway import Gateway
from gateway.monitoring.http_pages import Page
from gateway.outputs.contract import Output
from gateway.rtc3d.components import ComponentType
from gateway.source import Source
from gateway.stream.running_time import running_clock
from gateway.stream.state import StreamState
from gateway.stream.status import StreamStatus

_ONLY_EVENTS: Final = {ComponentType.EVENT}


def health_page(gateway: Gateway) -> Page:
    """Return the page /healthz: JSON with status 200, or 503 if a stream or an output has a problem."""
    now_s = running_clock().time()  # a stop of this process does not make the newest frames older
    streams = [
        _stream_health(source, stream, status, now_s)
        for source in gateway.sources
        for stream, status in zip(source.settings.streams, source.statuses, strict=True)
    ]
    outputs = [_output_health(output) for output in gateway.outputs]
    healthy = not any(each["problem"] for each in (*streams, *outputs))
    body = {"healthy": healthy, "streams": streams, "outputs": outputs}
    status = HTTPStatus.OK if healthy else HTTPStatus.SERVICE_UNAVAILABLE
    return Page(status, "application/json", json.dumps(body, ensure_ascii=False, indent=2).encode() + b"\n")


def _stream_health(
    source: Source, stream: StreamSettings, status: StreamStatus, now_s: float
) -> dict[str, Any]:
    age_s = None if status.last_frame_s is None else now_s - status.last_frame_s
    return {
        "source": source.name,
        "stream": status.components,
        "state": status.state.value,
        "last_frame_age_s": age_s,
        "problem": _stream_problem(source, stream, status, age_s),
    }


def _output_health(output: Output) -> dict[str, str]:
    health = output.health()
    return {"output": output.name, "problem": "" if health.connected else health.problem}


def _stream_problem(source: Source, stream: StreamSettings, status: StreamStatus, age_s: float | None) -> str:
    """Return what is wrong with a stream and what to check; "" if frames arrive or none are needed."""
    max_age_s = source.settings.stall_timeout_s
    if age_s is not None and age_s < max_age_s:
        return ""
    silence = "no frame so far" if age_s is None else f"no frame for {age_s:.1f} s (limit {max_age_s:g} s)"
    match status.state:
        case StreamState.NO_MEASUREMENT:
            return ""
        case StreamState.IDLE | StreamState.STREAMING if set(stream.components) == _ONLY_EVENTS:
            return ""  # events are sporadic
        case StreamState.IDLE if stream.on_demand and not source.fan_out.has_subscribers(stream.components):
            return ""
        case StreamState.IDLE:
            return (
                f"{silence}: {source.settings.host} is connected but sends nothing; is a measurement running?"
            )
    reason = status.last_error or f"connecting to {source.settings.host}:{source.settings.port}"
    return f"{silence}: {reason}"
