"""The doctor's verdicts on this computer's clock and on the health page of a running gateway."""

import pytest

from gateway.doctor import clock_check
from gateway.doctor.gateway_checks import check_gateway
from gateway.doctor.running_gateway import HealthReport, RunningLoss, RunningStream
from gateway.findings import Finding, Result


def test_the_clock_is_read() -> None:
    """The structure that the kernel fills has the right size and order."""
    is_synchronised, max_error_us = clock_check.read_clock()
    assert isinstance(is_synchronised, bool)
    assert max_error_us >= 0


@pytest.mark.parametrize(
    ("clock", "leaving", "result", "found"),
    [
        ((True, 1234), ["zenoh"], Result.PASSING, "synchronised, with an error of at most 1.2 ms"),
        ((False, 16_000_000), ["zenoh", "lcm"], Result.FAILING, ", which zenoh and lcm can reach"),
        ((False, 16_000_000), [], Result.WARNING, "; so far, all messages stay on this computer"),
    ],
)
def test_a_clock_matters_to_messages_that_leave(
    monkeypatch: pytest.MonkeyPatch, clock: tuple[bool, int], leaving: list[str], result: Result, found: str
) -> None:
    """Programs on this computer use the same clock; others compare utime with theirs."""
    monkeypatch.setattr(clock_check, "read_clock", lambda: clock)
    finding = clock_check.check_clock(leaving)
    assert finding.result is result
    assert finding.found.endswith(found)
    assert ("chrony" in finding.remedy) is (result is not Result.PASSING)


def test_a_clock_whose_state_is_not_reported_is_not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in containers that do not allow adjtimex."""

    def refuse() -> tuple[bool, int]:
        raise OSError(1, "adjtimex is not allowed")

    monkeypatch.setattr(clock_check, "read_clock", refuse)
    assert clock_check.check_clock(["zenoh"]) == Finding(
        "this computer", "clock", Result.NOT_TESTED, "the kernel does not report it: adjtimex is not allowed"
    )


def stream(state: str = "streaming", problem: str = "") -> RunningStream:
    return RunningStream(
        source="lab",
        stream="3d",
        server="192.0.2.9:3020",
        state=state,
        session=1,
        frames=7,
        frame_rate_hz=100.0,
        last_frame_age_s=0.1,
        limitations=[],
        problem=problem,
    )


def loss(last_minute: int) -> RunningLoss:
    return RunningLoss(
        source="lab",
        stream=None,
        output="zenoh",
        cause="no router",
        messages=5,
        frames=5,
        messages_last_minute=last_minute,
        frames_last_minute=last_minute,
        age_s=1.0,
        text="no router",
    )


def results(report: HealthReport, *sources: str) -> list[tuple[str, Result]]:
    findings = check_gateway(report, "127.0.0.1:9100", sources, connects=True)
    return [(finding.check, finding.result) for finding in findings][1:]


def test_only_sources_that_are_not_served_are_warnings() -> None:
    """The gateway runs with another configuration than the doctor reads."""
    report = HealthReport(streams=[stream()], outputs=[], losses=[])
    passing = [("stream", Result.PASSING), ("loss", Result.PASSING)]
    assert results(report, "lab") == passing
    assert results(report, "lab", "hall") == [("stream", Result.WARNING), *passing]


@pytest.mark.parametrize(("last_minute", "result"), [(0, Result.NOTE), (1, Result.WARNING)])
def test_only_recent_loss_is_a_warning(last_minute: int, result: Result) -> None:
    """What was lost long ago is history."""
    report = HealthReport(streams=[stream(problem="no frame")], outputs=[], losses=[loss(last_minute)])
    assert results(report, "lab") == [("stream", Result.FAILING), ("loss", result)]
