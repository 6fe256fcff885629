"""The monitoring server of a gateway: /metrics for Prometheus, /healthz for health checks; the status line.

A gateway is healthy if every stream receives frames in time, every output is connected, and nothing is lost.
"""

import asyncio
import json
import logging
from collections.abc import Iterator, Sequence
from http import HTTPStatus
from typing import Any, Final, NamedTuple

from gateway.config.settings import MetricsSettings, StreamSettings
from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.http_pages import HttpPages, Page
from gateway.daemon.monitoring.metrics import GatewayMetrics
from gateway.daemon.monitoring.process_limits import DiskFacts, LoopDelay, ProcessLimits
from gateway.daemon.source import Source
from gateway.errors import system_reason
from gateway.messages.source_report import StreamReport, streams_text
from gateway.runtime.losses import Loss, last_minute_text, route_name
from gateway.runtime.safe_text import safe_json
from gateway.session.process_clock import running_clock
from gateway.session.state import StreamState
from gateway.session.tcp import is_address, look_up

_LOOK_UP_TIMEOUT_S: Final = 5.0

_LATE_S: Final = 1.0
"""Frames that are later than this degrade the gateway: whoever uses them live would act on the past."""

logger = logging.getLogger(__name__)


class MonitoringServer:
    """Serves the metrics and the health of one gateway over HTTP."""

    def __init__(
        self, settings: MetricsSettings, gateway: Gateway, limits: ProcessLimits | None = None
    ) -> None:
        limits = limits or ProcessLimits()
        self._settings = settings
        self._loop_delay = LoopDelay()
        self._disk_facts = DiskFacts(gateway)
        self._look_up: asyncio.Task[None] | None = None
        metrics = GatewayMetrics(gateway, self._loop_delay, self._disk_facts)
        self._pages = HttpPages(
            {"/metrics": metrics.page, "/healthz": lambda: health_page(gateway, limits.problems())},
            settings.host,
        )

    async def start(self) -> None:
        """Listen if the settings enable it. If the port cannot be bound, log a warning and continue.

        A host name is looked up in the background, so that a name server that does not answer delays nothing.
        """
        if not self._settings.enabled:
            return
        self._loop_delay.start()
        self._disk_facts.start()
        if is_address(self._settings.host):
            await self._listen()
        else:
            self._look_up = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        host, port = self._settings.host, self._settings.port
        addresses: Sequence[str] = [host]
        try:
            if not is_address(host):
                async with asyncio.timeout(_LOOK_UP_TIMEOUT_S):
                    addresses = await look_up(host)
        except OSError as error:  # TimeoutError has no text
            logger.warning(
                "metrics: the host name %s cannot be resolved: %s; continuing without /metrics and /healthz: "
                "check the name server (DNS), or set metrics.host to an IP address, and restart",
                *(host, error.strerror or f"no answer within {_LOOK_UP_TIMEOUT_S:g} s"),
            )
            return
        try:
            await self._pages.start(addresses, port)
        except OSError as error:
            logger.warning(
                "metrics: cannot listen on %s, port %d: %s; continuing without /metrics and /healthz: "
                "stop the program that uses the port, or set metrics.host and metrics.port, and restart "
                "the gateway",
                *(host, port, system_reason(error)),
            )
        else:
            logger.info("metrics: /metrics and /healthz are served on %s, port %d", host, port)

    async def close(self) -> None:
        """Stop listening."""
        self._loop_delay.close()
        self._disk_facts.close()
        if self._look_up is not None:
            self._look_up.cancel()
        await self._pages.close()


class _PlaceOfLoss(NamedTuple):
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
    minute, frames are late, or an output has a warning, the gateway is degraded, which is still 200.
    """
    streams = [each for source in gateway.sources for each in _streams(source)]
    outputs = _outputs(gateway)
    problems = [
        *(f"gateway: {problem}" for problem in process_problems),
        *(f"{each['source']} ({each['stream']}): {each['problem']}" for each in streams if each["problem"]),
        *(f"{each['output']}: {each['problem']}" for each in outputs if each["problem"]),
    ]
    routes = list(_routes(gateway))
    late = [
        f"{each['source']} ({each['stream']}): the newest frame arrived {each['lag_s']:.1f} s late"
        for each in streams
        if each["lag_s"] >= _LATE_S and not each["problem"]
    ]
    warnings = [text for output in gateway.outputs for text in output.warnings()]
    losses = [f"{route.name}: {text}" for route in routes if (text := last_minute_text(route.losses))]
    causes = []
    for route in routes:
        names = {"source": route.source, "stream": route.stream, "output": route.output}
        causes += [names | loss._asdict() | {"age_s": round(loss.age_s, 1)} for loss in route.losses]
    body = {
        "status": "unhealthy" if problems else "degraded" if late or warnings or losses else "healthy",
        "healthy": not problems,
        "reasons": [*problems, *late, *warnings, *losses],
        "process": list(process_problems),
        "streams": streams,
        "outputs": outputs,
        "losses": causes,
    }
    status = HTTPStatus.SERVICE_UNAVAILABLE if problems else HTTPStatus.OK
    text = safe_json(json.dumps(body, ensure_ascii=False, indent=2))
    return Page(status, "application/json", f"{text}\n".encode())


def _streams(source: Source) -> Iterator[dict[str, Any]]:
    now_s = running_clock().time()  # a stop of this process does not make the newest frames older
    report = source.report
    for stream, supervisor in zip(report.streams, source.streams, strict=False):
        last_frame_s = supervisor.status.last_frame_s
        age_s = None if last_frame_s is None else now_s - last_frame_s
        yield {
            "source": report.name,
            "stream": stream.components,
            "server": report.server,
            "state": stream.state,
            "session": stream.session,
            "frames": stream.num_frames,
            "frame_rate_hz": round(stream.frame_rate_hz, 3),
            "lag_s": round(stream.lag_ms / 1000, 6),
            "last_frame_age_s": age_s,
            "limitations": stream.limitations,
            "problem": stream.problem or _stream_problem(source, supervisor.settings, stream, age_s),
        }


def _outputs(gateway: Gateway) -> list[dict[str, str]]:
    healths = ((output.name, output.health()) for output in gateway.outputs)
    return [
        {"output": name, "problem": "" if health.connected else health.problem} for name, health in healths
    ]


def _routes(gateway: Gateway) -> Iterator[_PlaceOfLoss]:
    """Yield what each stream lost before any output, and what each source lost on each output."""
    for source in gateway.sources:
        for status in source.statuses:
            yield _PlaceOfLoss(source.name, status.components, None, status.losses.report())
        for output, output_status in source.fan_out.outputs:
            yield _PlaceOfLoss(source.name, None, output.name, output_status.losses)


def _stream_problem(
    source: Source, settings: StreamSettings, stream: StreamReport, age_s: float | None
) -> str:
    """Return why no frame arrives and what to check; "" if frames arrive or none are needed."""
    max_age_s = source.settings.stall_timeout_s
    if age_s is not None and age_s < max_age_s:
        return ""
    match StreamState(stream.state):
        case StreamState.NO_MEASUREMENT:
            return ""
        case StreamState.IDLE | StreamState.STREAMING if settings.has_only_events:
            return ""
        case StreamState.IDLE if settings.on_demand:
            if not source.fan_out.has_subscribers(settings.components):
                return ""
    silence = "no frame so far" if age_s is None else f"no frame for {age_s:.1f} s (limit {max_age_s:g} s)"
    if stream.state == StreamState.IDLE.value:
        return f"{silence}: {source.settings.host} is connected but sends nothing; is a measurement running?"
    reason = stream.last_error or f"connecting to {source.settings.host}:{source.settings.port}"
    return f"{silence}: {reason}"


def status_lines(gateway: Gateway) -> list[str]:
    """Return a text for each source, for each output that cannot send, and for what an output loses.

    The line of a source is such as "lab: streaming 200.0 Hz". If the texts of its streams differ, the
    components of each stream precede its text.
    """
    lines = []
    for source in gateway.sources:
        texts = []
        for stream, status in zip(source.report.streams, source.statuses, strict=False):
            lost = last_minute_text(status.losses.report())
            texts.append((stream.components, f"{stream.text}, {lost}" if lost else stream.text))
        lines.append(f"{source.name}: {streams_text(texts)}")
    lines += [f"{each['output']}: {each['problem']}" for each in _outputs(gateway) if each["problem"]]
    lines += [text for output in gateway.outputs for text in output.warnings()]
    for route in _routes(gateway):
        if route.output and (text := last_minute_text(route.losses)):
            lines.append(f"{route.name}: {text}")
    return lines
