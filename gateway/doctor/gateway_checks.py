"""Checks of the running gateway, by its own health page: streams, outputs, and what was lost."""

from collections.abc import Iterator, Sequence
from typing import Final

from gateway.doctor.running_gateway import HealthReport, NoReport, RunningLoss, RunningOutput, RunningStream
from gateway.findings import Finding, Subject, as_sentence
from gateway.stream.state import StreamState

CHECKS: Final = ("health", "stream", "output", "loss")
"""The checks in order. All but the first are made once for each stream, output and loss."""

_gateway: Final = Subject("running gateway")


def check_gateway(
    report: HealthReport | NoReport, where: str, sources: Sequence[str], *, connects: bool
) -> Iterator[Finding]:
    """Yield findings about the running gateway, whose health page is at ``where``.

    ``sources`` are the names of the configured sources. ``connects`` says whether the doctor also connects
    to the servers itself.
    """
    if isinstance(report, NoReport):
        yield _no_gateway(report, connects=connects)
        for check in CHECKS[1:]:
            yield _gateway.not_tested(check, "no running gateway could be asked")
        return
    yield _gateway.passing("health", f"a gateway answers on {where}")
    for problem in report.process:
        found, _, remedy = problem.partition("; ")
        yield _gateway.failing("health", found, as_sentence(remedy))
    served = {stream.source for stream in report.streams}
    for source in sources:
        if source not in served:
            yield _gateway.warning(
                "stream",
                f"{source}: the running gateway has no source of this name",
                "It runs with another configuration. Reload or restart it with this one, or check "
                "metrics.port.",
            )
    for stream in report.streams:
        yield from _check_stream(stream, connects=connects)
    for output in report.outputs:
        yield _check_output(output)
    if not report.losses:
        yield _gateway.passing("loss", "nothing has been lost since the gateway started")
    for loss in report.losses:
        yield _check_loss(loss)


def _no_gateway(report: NoReport, *, connects: bool) -> Finding:
    if report.something_answers:
        return _gateway.failing(
            "health",
            report.reason,
            "If it is the gateway, read its log and restart it. If it is another program, set metrics.port.",
        )
    if connects:
        return _gateway.note(
            "health",
            report.reason,
            "The checks below open connections of their own to the servers. They cannot tell what a gateway "
            "has lost.",
        )
    return _gateway.failing(
        "health",
        report.reason,
        "Start the gateway, or check metrics in the configuration. Without --no-connect, doctor connects "
        "to the servers itself.",
    )


def _check_stream(stream: RunningStream, *, connects: bool) -> Iterator[Finding]:
    age = f", the newest {stream.last_frame_age_s:.1f} s ago" if stream.last_frame_age_s is not None else ""
    found = (
        f"{stream.name}: {stream.state}, {stream.frame_rate_hz:.1f} Hz from {stream.server}; "
        f"{stream.frames} frames so far{age}"
    )
    if stream.problem:
        remedy = (
            f"The checks of {stream.source} below look for the reason."
            if connects
            else "Check the server and the network. Without --no-connect, doctor looks for the reason."
        )
        yield _gateway.failing("stream", f"{stream.name}: {stream.state}: {stream.problem}", remedy)
    elif stream.state == StreamState.NO_MEASUREMENT.value:
        yield _gateway.failing(
            "stream",
            f"{stream.name}: {stream.server} reports that no measurement is running",
            "Start a measurement on the server; the gateway then streams automatically.",
        )
    else:
        yield _gateway.passing("stream", found)
    for limitation in stream.limitations:
        yield _gateway.note("stream", f"{stream.name}: {limitation}")


def _check_output(output: RunningOutput) -> Finding:
    if not output.problem:
        return _gateway.passing("output", f"{output.output}: connected")
    found, _, remedy = output.problem.partition("; ")
    return _gateway.failing(
        "output",
        f"{output.output}: {found}",
        as_sentence(remedy) if remedy else f"See the checks of {output.output} below.",
    )


def _check_loss(loss: RunningLoss) -> Finding:
    what_to_do = f"The newest was: {loss.text}"
    if loss.messages_last_minute:
        return _gateway.warning("loss", loss.found, what_to_do)
    return _gateway.note("loss", loss.found, what_to_do)
