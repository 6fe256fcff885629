"""The doctor's verdict on measured rates, at its limits."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gateway.doctor import rate_check
from gateway.doctor.observation import ObservedStream
from gateway.findings import Finding, Result, Subject
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Parameters

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG


def check(
    monkeypatch: pytest.MonkeyPatch,
    announced_hz: Mapping[ComponentType, float],
    measured_hz: Mapping[ComponentType, float],
    rate: AllFrames | Frequency | FrequencyDivisor,
) -> Finding:
    monkeypatch.setattr(rate_check, "described_rate_hz", lambda _, component: announced_hz.get(component))
    stream: Any = SimpleNamespace(
        observed={component: SimpleNamespace(rate_hz=hz) for component, hz in measured_hz.items()},
        settings=SimpleNamespace(rate=rate),
        shares_connection=False,
    )
    return rate_check.check_rate(Subject("lab"), cast("ObservedStream", stream), cast("Parameters", object()))


@pytest.mark.parametrize(
    ("announced_hz", "measured_hz", "rate", "result"),
    [
        ({MARKERS: 100}, {MARKERS: 90}, AllFrames(), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 89.9}, AllFrames(), Result.FAILING),
        ({MARKERS: 100}, {MARKERS: 110}, AllFrames(), Result.PASSING),
        ({MARKERS: 100}, {MARKERS: 110.2}, AllFrames(), Result.FAILING),
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
    monkeypatch: pytest.MonkeyPatch,
    announced_hz: Mapping[ComponentType, float],
    measured_hz: Mapping[ComponentType, float],
    rate: AllFrames | Frequency | FrequencyDivisor,
    result: Result,
) -> None:
    """A tenth more or less than announced or requested passes; a divisor counts from the slowest rate."""
    assert check(monkeypatch, announced_hz, measured_hz, rate).result is result


@pytest.mark.parametrize(
    ("tools_hz", "is_limited"), [(100, True), (40, False)], ids=["like-the-slowest", "slower-still"]
)
def test_only_a_rate_of_the_slowest_component_is_explained_by_it(
    monkeypatch: pytest.MonkeyPatch, tools_hz: float, is_limited: bool
) -> None:
    """The advice to move a component to another stream helps only if every slow one has this reason."""
    announced_hz = {MARKERS: 100, TOOLS: 400, ANALOG: 1000}
    measured_hz = {MARKERS: 100, TOOLS: tools_hz, ANALOG: 100}
    finding = check(monkeypatch, announced_hz, measured_hz, AllFrames())
    assert finding.result is Result.FAILING
    assert ("stream of their own" in finding.remedy) is is_limited
