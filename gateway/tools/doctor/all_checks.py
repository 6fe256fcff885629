"""All checks, layer by layer, so that a fault is found before its consequences.

Those of sources are in source_checks; those of the running gateway, by its own health page, of outputs and of
this computer's clock are here.
"""

import asyncio
import contextlib
import ctypes
import http.client
import json
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple

from pydantic import BaseModel, ValidationError

from gateway.config.settings import MetricsSettings, OutputSettings, Settings
from gateway.errors import ConfigError
from gateway.outputs.findings import NO_CONFIGURATION, Check, Finding, MessageLoad, as_sentence
from gateway.outputs.kind import OPENS, OutputKind
from gateway.outputs.listen_address import from_this_computer, host_in_url
from gateway.outputs.registry import OUTPUTS, UNUSABLE
from gateway.runtime.losses import counts_text, route_name
from gateway.runtime.workers import WorkerThread
from gateway.session.state import StreamState
from gateway.tools.doctor.frame_checks import START
from gateway.tools.doctor.source_checks import CHECKS, SourceChecks

_POLL_S: Final = 0.05


def check_output(
    kind: OutputKind,
    settings: OutputSettings,
    sources: Sequence[str],
    loads: Sequence[MessageLoad],
    seconds: float,
) -> list[Finding]:
    """Run the checks of one output, or check that it opens, as in the gateway. Blocks for about ``seconds``.

    ``sources`` are the names of all sources, ``loads`` the messages that they make.
    """
    if not settings.enabled:
        reason = f"{kind.name}.enabled is false"
        return [Check(kind.name, check).not_tested(reason) for check in kind.checks]
    if kind.run_checks is not None:
        return kind.run_checks(settings, sources, loads, seconds)
    check = Check(kind.name, OPENS)
    default_remedy = f"Correct {kind.name} in the configuration."
    try:
        output = kind.create(settings)
    except ConfigError as error:
        return [check.failing(str(error), default_remedy)]
    output.start()
    deadline_s = time.monotonic() + seconds
    while not output.health().connected and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
        output.maintain()
    health = output.health()
    output.close()
    if health.connected:
        return [check.passing("the output opens")]
    return [check.problem(health.problem, default_remedy)]


_FILE: Final = Check("configuration", "file")


async def run_checks(
    settings: Settings,
    origin: str,
    seconds: float,
    *,
    connects: bool = True,
    output_sections: Mapping[str, OutputSettings] | None = None,
) -> AsyncIterator[Finding]:
    """Run all checks, and yield each finding as soon as it is known.

    The running gateway is asked first. Then the sources are watched one after the other, each for
    ``seconds``, unless ``connects`` is False: then no connection to their servers is opened. Outputs that
    are not enabled come after the others.

    ``origin`` says where the settings come from, for example a file name. ``output_sections`` replace those
    of the settings where an output is checked.
    """
    enabled = [name for name, section in settings.outputs.items() if section.enabled]
    names = [source.name for source in settings.sources]
    yield _FILE.passing(f"{origin}: {', '.join(names)} to {', '.join(enabled)}")
    report = await read_health(settings.metrics)
    for finding in check_gateway(report, address_text(settings.metrics), names, connects=connects):
        yield finding
    not_yet = {StreamState.WAITING.value, StreamState.CONNECTING.value}
    streams = report.streams if isinstance(report, HealthReport) else []
    connected = [stream.server for stream in streams if stream.state not in not_yet]
    loads: list[MessageLoad] = []
    for source in settings.sources:
        checks = SourceChecks(source, seconds, connected)
        async for finding in checks.run() if connects else checks.run_without_connecting():
            yield finding
        loads += checks.message_loads
    sections = {**settings.outputs, **(output_sections or {})}
    for name, section in sorted(sections.items(), key=lambda item: not item[1].enabled):
        check = partial(check_output, OUTPUTS[name], section, names, loads, seconds)
        for finding in await WorkerThread(name).run(check):
            yield finding
    for name, text in UNUSABLE.items():
        found, _, remedy = text.rpartition("; ")
        yield Check(name, "package").warning(found, as_sentence(remedy))
    leaving = [name for name in enabled if OUTPUTS[name].leaves_host(settings.outputs[name])]
    yield check_clock(leaving)


def run_checks_without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield ``error`` as a finding, and run the checks that need no settings."""
    yield _FILE.failing(str(error), "Correct these lines; config/gateway.yaml explains every key.")
    subjects = {
        "running gateway": GATEWAY_CHECKS,
        "source": CHECKS,
        **{name: kind.checks for name, kind in OUTPUTS.items()},
    }
    for subject, checks in subjects.items():
        for check in checks:
            yield Check(subject, check).not_tested(NO_CONFIGURATION)
    yield check_clock([])


# The running gateway -----------------------------------------------------------------------

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


GATEWAY_CHECKS: Final = ("health", "stream", "output", "loss")
"""The checks in order. All but the first are made once for each stream, output and loss."""

_HEALTH, _STREAM, _OUTPUT, _LOSS = (Check("running gateway", name) for name in GATEWAY_CHECKS)


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


# The clock ---------------------------------------------------------------------------------

_STA_UNSYNC: Final = 0x40  # linux/timex.h

_CLOCK: Final = Check("this computer", "clock")


class _Timex(ctypes.Structure):
    """The first fields of Linux's struct timex, and space for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def read_clock() -> tuple[bool, int]:
    """Return whether the kernel's clock is synchronised, and its maximum error in µs.

    Raises OSError if the kernel does not report it, as in some containers.
    """
    timex = _Timex()  # modes is 0, so adjtimex changes nothing
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "adjtimex"):
        raise OSError("this system has no adjtimex")
    if libc.adjtimex(ctypes.byref(timex)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex is not allowed")
    return not timex.status & _STA_UNSYNC, timex.maxerror


def check_clock(leaving: Sequence[str]) -> Finding:
    """Check that this computer's clock is synchronised: if not, a warning.

    Isolated laboratory networks often have no time server, and everything else works. ``leaving`` names the
    outputs whose messages leave this computer, to programs with other clocks.
    """
    try:
        is_synchronised, max_error_us = read_clock()
    except OSError as error:
        return _CLOCK.not_tested(f"the kernel does not report it: {error.strerror or error}")
    if is_synchronised:
        return _CLOCK.passing(f"synchronised, with an error of at most {max_error_us / 1000:.1f} ms")
    found = (
        "this computer's clock is not synchronised, so utime cannot be compared with the clocks of other "
        "computers"
    )
    remedy = (
        "Set up chrony or systemd-timesyncd with the lab's time server; `chronyc tracking` or `timedatectl` "
        "shows the state. In a container, do this on the host."
    )
    if leaving:
        return _CLOCK.warning(f"{found}, which {' and '.join(leaving)} can reach", remedy)
    return _CLOCK.warning(f"{found}; so far, all messages stay on this computer", remedy)
