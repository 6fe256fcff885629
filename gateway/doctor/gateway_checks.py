"""Checks of the running gateway, by its own health page: streams, outputs, and what was lost."""

import asyncio
import contextlib
import http.client
import json
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final, NamedTuple

from pydantic import BaseModel, ValidationError

from gateway.config.settings import MetricsSettings
from gateway.doctor.frame_checks import START
from gateway.logs.losses import counts_text, route_name
from gateway.outputs.findings import Check, Finding
from gateway.outputs.listen_address import from_this_computer, host_in_url
from gateway.stream.state import StreamState
from gateway.workers import WorkerThread

_TIMEOUT_S: Final = 3.0
_MAX_PAGE_BYTES: Final = 4 << 20


class RunningStream(BaseModel):
    """One stream on the health page."""

    source: str
    stream: str
    server: str
    state: str
    session: int
    frames: int
    frame_rate_hz: float
    last_frame_age_s: float | None
    limitations: list[str]
    problem: str


class RunningOutput(BaseModel):
    """One output on the health page."""

    output: str
    problem: str


class RunningLoss(BaseModel):
    """What was lost for one cause, of one stream before any output, or of one source on one output."""

    source: str
    stream: str | None
    output: str | None
    cause: str
    messages: int
    frames: int
    messages_last_minute: int
    frames_last_minute: int
    age_s: float
    text: str

    @property
    def found(self) -> str:
        """What was lost, where, and when."""
        route = route_name(self.source, self.stream, self.output)
        total = counts_text([(self.cause, self.messages, self.frames)])
        if not self.messages_last_minute:
            return f"{route}: lost since the start: {total}; nothing in the last minute"
        recent = counts_text([(self.cause, self.messages_last_minute, self.frames_last_minute)])
        return f"{route}: lost in the last minute: {recent}; since the start: {total}"


class HealthReport(BaseModel):
    """The health page of a running gateway. ``process`` are the problems of the whole process."""

    process: list[str] = []
    streams: list[RunningStream]
    outputs: list[RunningOutput]
    losses: list[RunningLoss]


class NoReport(NamedTuple):
    """Why there is no health page. If something answers on the address, it may be a gateway in trouble."""

    reason: str
    something_answers: bool


def address_text(metrics: MetricsSettings) -> str:
    """Return where a gateway with these settings serves its health page, for example "127.0.0.1:9464"."""
    return f"{host_in_url(from_this_computer(metrics.host))}:{metrics.port}"


async def read_health(metrics: MetricsSettings) -> HealthReport | NoReport:
    """Read the health page of the gateway that serves it at these settings, within 3 s."""
    if not metrics.enabled:
        return NoReport("metrics.enabled is false, so a running gateway cannot be asked", False)
    where = address_text(metrics)
    try:
        async with asyncio.timeout(2 * _TIMEOUT_S):  # includes looking up a host name
            page = await WorkerThread("health page").run(partial(_get, metrics))
    except ConnectionRefusedError:
        return NoReport(f"no gateway runs here: nothing listens on {where}", False)
    except TimeoutError:
        return NoReport(f"{where} does not answer within {_TIMEOUT_S:g} s", True)
    except (OSError, http.client.HTTPException) as error:
        return NoReport(
            f"{where} gives no health page: {error}", isinstance(error, http.client.HTTPException)
        )
    try:
        return HealthReport.model_validate(json.loads(page))
    except (ValueError, ValidationError):
        return NoReport(f"the program on {where} is not a gateway of this version", True)


def _get(metrics: MetricsSettings) -> bytes:
    host = from_this_computer(metrics.host)
    with contextlib.closing(http.client.HTTPConnection(host, metrics.port, timeout=_TIMEOUT_S)) as connection:
        connection.request("GET", "/healthz")
        return connection.getresponse().read(_MAX_PAGE_BYTES)


CHECKS: Final = ("health", "stream", "output", "loss")
"""The checks in order. All but the first are made once for each stream, output and loss."""

_HEALTH, _STREAM, _OUTPUT, _LOSS = (Check("running gateway", name) for name in CHECKS)


def check_gateway(
    report: HealthReport | NoReport, where: str, sources: Sequence[str], *, connects: bool
) -> Iterator[Finding]:
    """Yield findings about the running gateway, whose health page is at ``where``.

    ``sources`` are the names of the configured sources. ``connects`` says whether the doctor also connects
    to the servers itself.
    """
    if isinstance(report, NoReport):
        yield _no_gateway(report, connects=connects)
        for check in (_STREAM, _OUTPUT, _LOSS):
            yield check.not_tested("no running gateway could be asked")
        return
    yield _HEALTH.passing(f"a gateway answers on {where}")
    for problem in report.process:
        yield _HEALTH.problem(problem)
    served = {stream.source for stream in report.streams}
    for source in sources:
        if source not in served:
            yield _STREAM.warning(
                f"{source}: the running gateway has no source of this name",
                "It runs with another configuration. Reload or restart it with this one, or check "
                "metrics.port.",
            )
    for stream in report.streams:
        yield from _check_stream(stream, connects=connects)
    for output in report.outputs:
        name, problem = output.output, output.problem
        yield (
            _OUTPUT.problem(f"{name}: {problem}", f"See the checks of {name} below.")
            if problem
            else _OUTPUT.passing(f"{name}: connected")
        )
    if not report.losses:
        yield _LOSS.passing("nothing has been lost since the gateway started")
    for loss in report.losses:
        finding = _LOSS.warning if loss.messages_last_minute else _LOSS.note
        yield finding(loss.found, f"The newest was: {loss.text}")


def _no_gateway(report: NoReport, *, connects: bool) -> Finding:
    if report.something_answers:
        return _HEALTH.failing(
            report.reason,
            "If it is the gateway, read its log and restart it. If it is another program, set metrics.port.",
        )
    if connects:
        return _HEALTH.note(
            report.reason,
            "The checks below open connections of their own to the servers. They cannot tell what a gateway "
            "has lost.",
        )
    return _HEALTH.failing(
        report.reason,
        "Start the gateway, or check metrics in the configuration. Without --no-connect, doctor connects "
        "to the servers itself.",
    )


def _check_stream(stream: RunningStream, *, connects: bool) -> Iterator[Finding]:
    name = f"{stream.source} ({stream.stream})"
    age = f", the newest {stream.last_frame_age_s:.1f} s ago" if stream.last_frame_age_s is not None else ""
    if stream.problem:
        remedy = (
            f"The checks of {stream.source} below look for the reason."
            if connects
            else "Check the server and the network. Without --no-connect, doctor looks for the reason."
        )
        yield _STREAM.failing(f"{name}: {stream.state}: {stream.problem}", remedy)
    elif stream.state == StreamState.NO_MEASUREMENT.value:
        yield _STREAM.failing(f"{name}: {stream.server} reports that no measurement is running", START)
    else:
        yield _STREAM.passing(
            f"{name}: {stream.state}, {stream.frame_rate_hz:.1f} Hz from {stream.server}; "
            f"{stream.frames} frames so far{age}"
        )
    for limitation in stream.limitations:
        yield _STREAM.note(f"{name}: {limitation}")
