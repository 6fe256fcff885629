"""The doctor's verdicts: on the clock, a running gateway, rates and the receive buffer; and their guide."""

import re
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gateway.outputs.findings import Check, Finding, Result
from gateway.outputs.kind import OPENS
from gateway.outputs.registry import OUTPUTS
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters
from gateway.session.state import StreamState
from gateway.tools.doctor import all_checks, frame_checks, source_checks
from gateway.tools.doctor.all_checks import HealthReport, RunningLoss, RunningStream, check_gateway
from gateway.tools.doctor.frame_checks import check_receive_buffer
from gateway.tools.doctor.observation import ObservedStream
from tests.support.errors import names


def test_the_clock_is_read() -> None:
    """The structure that the kernel fills has the right size and order."""
    is_synchronised, max_error_us = all_checks.read_clock()
    assert isinstance(is_synchronised, bool)
    assert max_error_us >= 0


@pytest.mark.parametrize(
    ("clock", "leaving", "result", "found"),
    [
        ((True, 1234), ["zenoh"], Result.PASSING, "1.2 ms"),
        ((False, 16_000_000), ["zenoh", "lcm"], Result.WARNING, "zenoh and lcm"),
        ((False, 16_000_000), [], Result.WARNING, "this computer"),
    ],
)
def test_a_clock_that_is_not_synchronised_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, clock: tuple[bool, int], leaving: list[str], result: Result, found: str
) -> None:
    """An isolated network has no time server; only programs elsewhere compare utime with their clocks."""
    monkeypatch.setattr(all_checks, "read_clock", lambda: clock)
    finding = all_checks.check_clock(leaving)
    assert finding.result is result
    assert names(finding.found, found)
    assert ("chrony" in finding.remedy) is (result is not Result.PASSING)


def test_a_clock_whose_state_is_not_reported_is_not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in containers that do not allow adjtimex."""

    def refuse() -> tuple[bool, int]:
        raise OSError(1, "adjtimex is not allowed")

    monkeypatch.setattr(all_checks, "read_clock", refuse)
    finding = all_checks.check_clock(["zenoh"])
    assert finding.result is Result.NOT_TESTED
    assert names(finding.found, "adjtimex is not allowed")


def stream(problem: str = "") -> RunningStream:
    values: dict[str, object] = {"source": "lab", "stream": "3d", "server": "192.0.2.9:3020"}
    values |= {
        "state": "streaming",
        "session": 1,
        "frames": 7,
        "frame_rate_hz": 100.0,
        "last_frame_age_s": 0.1,
        "limitations": [],
    }
    return RunningStream.model_validate(values | {"problem": problem})


def loss(last_minute: int) -> RunningLoss:
    values = {"source": "lab", "stream": None, "output": "zenoh", "cause": "no router", "text": "no router"}
    amounts = {"messages": 5, "frames": 5, "messages_last_minute": last_minute}
    return RunningLoss.model_validate(values | amounts | {"frames_last_minute": last_minute, "age_s": 1.0})


def results(report: HealthReport, *sources: str) -> list[tuple[str, Result]]:
    findings = check_gateway(report, "127.0.0.1:9100", sources, connects=True)
    return [(finding.check, finding.result) for finding in findings][1:]


def test_only_sources_that_are_not_served_are_warnings() -> None:
    """The gateway runs with another configuration than the doctor reads."""
    report = HealthReport(streams=[stream()], outputs=[], losses=[])
    passing = [("stream", Result.PASSING), ("loss", Result.PASSING)]
    assert results(report, "lab") == passing
    assert results(report, "lab", "hall") == [("stream", Result.WARNING), *passing]


def test_what_the_system_refuses_to_the_gateway_is_a_failure() -> None:
    report = HealthReport(process=["no file; close some"], streams=[stream()], outputs=[], losses=[])
    assert results(report, "lab")[0] == ("health", Result.FAILING)


@pytest.mark.parametrize(("last_minute", "result"), [(0, Result.NOTE), (1, Result.WARNING)])
def test_only_recent_loss_is_a_warning(last_minute: int, result: Result) -> None:
    """What was lost long ago is history."""
    report = HealthReport(streams=[stream(problem="no frame")], outputs=[], losses=[loss(last_minute)])
    assert results(report, "lab") == [("stream", Result.FAILING), ("loss", result)]


MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG


Rates = Mapping[ComponentType, float]


def rate_finding(
    monkeypatch: pytest.MonkeyPatch, announced_hz: Rates, measured_hz: Rates, rate: Rate
) -> Finding:
    monkeypatch.setattr(frame_checks, "described_rate_hz", lambda _, component: announced_hz.get(component))
    observed = {component: SimpleNamespace(rate_hz=hz) for component, hz in measured_hz.items()}
    settings = SimpleNamespace(rate=rate)
    stream: Any = SimpleNamespace(observed=observed, settings=settings, shares_connection=False)
    return frame_checks.check_rate(
        Check("lab", "rate"), cast("ObservedStream", stream), cast("Parameters", object())
    )


@pytest.mark.parametrize(
    ("announced_hz", "measured_hz", "rate", "result"),
    [
        ({MARKERS: 100}, {MARKERS: 90}, AllFrames(), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 89.9}, AllFrames(), Result.FAILING),
        ({MARKERS: 100}, {MARKERS: 110}, AllFrames(), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 110.2}, AllFrames(), Result.FAILING),
        ({MARKERS: 100, TOOLS: 100}, {MARKERS: 100, TOOLS: 120}, AllFrames(), Result.FAILING),
        ({MARKERS: 100, TOOLS: 100}, {MARKERS: 120, TOOLS: 100}, AllFrames(), Result.FAILING),
        ({MARKERS: 100, TOOLS: 100}, {MARKERS: 100, TOOLS: 80}, AllFrames(), Result.FAILING),
        ({MARKERS: 100}, {MARKERS: 100}, Frequency(200), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 50}, Frequency(50), Result.PASSING),
        ({}, {MARKERS: 50}, Frequency(50), Result.PASSING),
        ({MARKERS: 100, ANALOG: 1000}, {MARKERS: 50, ANALOG: 50}, FrequencyDivisor(2), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 100}, FrequencyDivisor(2), Result.FAILING),
        ({}, {MARKERS: 50}, FrequencyDivisor(2), Result.NOTE),
        ({}, {MARKERS: 50}, AllFrames(), Result.NOT_TESTED),
        ({MARKERS: 100}, {MARKERS: 0}, AllFrames(), Result.NOT_TESTED),
    ],
)
def test_the_limits_of_a_rate(
    monkeypatch: pytest.MonkeyPatch, announced_hz: Rates, measured_hz: Rates, rate: Rate, result: Result
) -> None:
    """A tenth more or less than announced or requested passes; a divisor counts from the slowest rate."""
    assert rate_finding(monkeypatch, announced_hz, measured_hz, rate).result is result


@pytest.mark.parametrize(
    ("rates_hz", "silence_s", "result"),
    [
        ({MARKERS: 100}, 0.5, Result.PASSING),
        ({MARKERS: 100}, 0.6, Result.FAILING),
        ({MARKERS: 5}, 0.9, Result.PASSING),
        ({MARKERS: 5}, 1.1, Result.FAILING),
        ({MARKERS: 5, ANALOG: 1000}, 0.6, Result.FAILING),
        ({MARKERS: 5, ComponentType.EVENT: 1}, 0.9, Result.PASSING),
        ({ComponentType.EVENT: 100}, 60, Result.PASSING),
        ({MARKERS: 0}, 0.6, Result.FAILING),
    ],
)
def test_frames_have_stopped_after_half_a_second_and_five_frames_of_the_fastest_component(
    rates_hz: Rates, silence_s: float, result: Result
) -> None:
    observed = {
        component: SimpleNamespace(rate_hz=hz, message_load=SimpleNamespace(largest_bytes=100))
        for component, hz in rates_hz.items()
    }
    status = SimpleNamespace(
        frames_in=500,
        losses=SimpleNamespace(frames=lambda _cause: 0),
        state=StreamState.STREAMING,
        last_error="",
    )
    stream: Any = SimpleNamespace(
        observed=observed,
        silence_s=silence_s,
        settings=SimpleNamespace(components=tuple(rates_hz)),
        status=status,
        session=SimpleNamespace(is_open=True),
        requests_all=True,
        component_keys="",
    )
    finding = frame_checks.check_frames(Check("lab", "frames"), stream, None, others_receive=False)
    assert finding.result is result


@pytest.mark.parametrize(
    ("tools_hz", "is_limited"), [(100, True), (40, False)], ids=["like-the-slowest", "slower-still"]
)
def test_only_a_rate_of_the_slowest_component_is_explained_by_it(
    monkeypatch: pytest.MonkeyPatch, tools_hz: float, is_limited: bool
) -> None:
    """The advice to move a component to another stream helps only if every slow one has this reason."""
    announced_hz = {MARKERS: 100, TOOLS: 400, ANALOG: 1000}
    measured_hz = {MARKERS: 100, TOOLS: tools_hz, ANALOG: 100}
    finding = rate_finding(monkeypatch, announced_hz, measured_hz, AllFrames())
    assert finding.result is Result.FAILING
    assert names(finding.remedy, "Move") is is_limited


@pytest.mark.parametrize(
    ("visible", "result"),
    [
        ({MARKERS: 0.5, TOOLS: 0.5}, Result.PASSING),
        ({MARKERS: 1.0, TOOLS: 0.49}, Result.FAILING),
        ({MARKERS: 0.49, TOOLS: 1.0}, Result.FAILING),
        ({MARKERS: 0.0}, Result.FAILING),
        ({TOOLS: 1.0}, Result.PASSING),
        ({}, Result.NOT_TESTED),
    ],
)
def test_half_of_the_markers_and_half_of_the_tools_must_be_in_view(
    visible: dict[ComponentType, float], result: Result
) -> None:
    """Many markers that are seen do not make up for tools that nobody sees."""
    observed = {
        component: SimpleNamespace(visible_share=share, never_visible_indices=[0])
        for component, share in visible.items()
    }
    stream = cast(ObservedStream, SimpleNamespace(observed=observed))
    finding = frame_checks.check_visibility(Check("lab", "visibility"), stream, None)
    assert finding.result is result
    assert all(names(finding.found, component.item_noun) for component in visible)


LINUX = "4096\t131072\t6291456\n"


def buffer_finding(folder: Path, tcp_rmem: str, load_bytes_per_s: float) -> Finding:
    path = folder / "tcp_rmem"
    path.write_text(tcp_rmem)
    return check_receive_buffer(Check("lab", "buffer"), load_bytes_per_s, path)


def test_a_buffer_for_two_seconds_passes(tmp_path: Path) -> None:
    for load_bytes_per_s, time_s, rate in ((150_000, 21, 0.15), (1_500_000, 2, 1.5), (100, 60, 0.0001)):
        finding = buffer_finding(tmp_path, LINUX, load_bytes_per_s)
        assert finding.result is Result.PASSING
        assert names(finding.found, f"{time_s} s", f"{rate} MB/s")


def test_a_smaller_buffer_fails_with_what_to_set_and_that_passes(tmp_path: Path) -> None:
    finding = buffer_finding(tmp_path, LINUX, 2_252_000)
    assert (finding.subject, finding.check, finding.result) == ("lab", "buffer", Result.FAILING)
    assert names(finding.found, "1.4 s", "2.3 MB/s")
    setting = "net.ipv4.tcp_rmem = 4096 131072 9437184"
    assert names(finding.remedy, 'sysctl -w net.ipv4.tcp_rmem="4096 131072 9437184"', setting)
    assert buffer_finding(tmp_path, "4096 131072 9437184", 2_252_000).result is Result.PASSING


def test_an_unknown_size_or_load_is_not_tested(tmp_path: Path) -> None:
    for tcp_rmem in ("", "4096 131072", "a b c"):
        finding = buffer_finding(tmp_path, tcp_rmem, 1000)
        assert finding.result is Result.NOT_TESTED
        assert names(finding.found, tmp_path / "tcp_rmem")
    finding = check_receive_buffer(Check("lab", "buffer"), 1000, tmp_path / "missing")  # as without Linux
    assert finding.result is Result.NOT_TESTED
    assert buffer_finding(tmp_path, LINUX, 0.0).result is Result.NOT_TESTED


GUIDE = (Path(__file__).parents[4] / "docs/how-to/troubleshoot.md").read_text(encoding="utf-8")


def test_the_guide_lists_every_check_in_order() -> None:
    table = GUIDE.partition("## What doctor checks")[2].partition("\n## ")[0]
    checks = re.findall(r"^\| [^|]*\| ([\w ]+) \|", table, re.MULTILINE)
    expected = [
        "file",
        *all_checks.GATEWAY_CHECKS,
        *source_checks.CHECKS,
        *(check for kind in OUTPUTS.values() for check in kind.checks),
        OPENS,
        "clock",
    ]
    assert [check for check in checks if check != "check"] == expected
