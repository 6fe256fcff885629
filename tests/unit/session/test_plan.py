"""Which components share a connection, by the rates that a server announces."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Tool,
)
from gateway.session.plan import (
    FIRST_WAIT_S,
    MAX_HALVINGS,
    MAX_WAIT_S,
    LagControl,
    StreamPlan,
    announced_rates_hz,
    halved,
    plan_streams,
    request_forms,
)
from tests.support.errors import names

MARKERS, TOOLS, ANALOG, FORCE, EVENT = (
    ComponentType.MARKERS,
    ComponentType.TOOLS,
    ComponentType.ANALOG,
    ComponentType.FORCE,
    ComponentType.EVENT,
)
NO_RATES = (
    "the server does not announce the rates of its components, so they share one connection, on which all "
    "components arrive at the rate of the slowest"
)


def announcing(rates_hz: Mapping[ComponentType, float | None]) -> Parameters:
    """Return parameters with one item of each of these components, and its rate."""
    return Parameters(
        markers=Parameters3D(rates_hz[MARKERS], markers=(Marker("1"),)) if MARKERS in rates_hz else None,
        tools=Parameters6D(rates_hz[TOOLS], tools=(Tool("1"),)) if TOOLS in rates_hz else None,
        analog=ParametersAnalog((AnalogChannel("1", frequency_hz=rates_hz[ANALOG]),))
        if ANALOG in rates_hz
        else None,
        force=ParametersForce((Plate("1", frequency_hz=rates_hz[FORCE]),)) if FORCE in rates_hz else None,
    )


@pytest.mark.parametrize(
    ("rates_hz", "groups"),
    [
        ({MARKERS: 200, TOOLS: 200, ANALOG: 200}, [WIRE_ORDER]),
        ({MARKERS: 200, ANALOG: 2000}, [(MARKERS, TOOLS, FORCE, EVENT), (ANALOG,)]),
        (
            {MARKERS: 200, TOOLS: 100, ANALOG: 2000, FORCE: 2000},
            [(TOOLS, EVENT), (MARKERS,), (ANALOG, FORCE)],
        ),
        (
            {MARKERS: 200, TOOLS: 100, ANALOG: 2000, FORCE: 1000},
            [(TOOLS, EVENT), (MARKERS,), (FORCE,), (ANALOG,)],
        ),
        ({MARKERS: 500, ANALOG: 100}, [(TOOLS, ANALOG, FORCE, EVENT), (MARKERS,)]),
        ({MARKERS: 60, ANALOG: 59.94}, [WIRE_ORDER]),
        ({MARKERS: 60, ANALOG: 61}, [(MARKERS, TOOLS, FORCE, EVENT), (ANALOG,)]),
        ({TOOLS: 400}, [WIRE_ORDER]),
    ],
)
def test_components_of_one_rate_share_a_connection(
    rates_hz: Mapping[ComponentType, float], groups: list[tuple[ComponentType, ...]]
) -> None:
    plan = plan_streams(announcing(rates_hz))
    assert list(plan.groups) == groups
    assert plan.limitation == ""
    assert sorted(component for group in plan.groups for component in group) == sorted(WIRE_ORDER)
    assert list(plan.rates_hz) == sorted(plan.rates_hz)


@pytest.mark.parametrize("parameters", [None, Parameters(), announcing({MARKERS: None, ANALOG: None})])
def test_a_server_without_rates_gets_one_connection(parameters: Parameters | None) -> None:
    assert plan_streams(parameters) == StreamPlan((WIRE_ORDER,), (), NO_RATES)


def test_what_has_no_rate_of_its_own_shares_the_connection() -> None:
    assert plan_streams(announcing({TOOLS: None})) == StreamPlan()
    assert "rates of analog, so" in plan_streams(announcing({MARKERS: 200, ANALOG: 0})).limitation
    without_items = replace(announcing({ANALOG: 2000, TOOLS: 2000}), markers=Parameters3D(200.0))
    assert plan_streams(without_items).groups == (WIRE_ORDER,)


@pytest.mark.parametrize(
    ("rates_hz", "cost"),
    [
        ({MARKERS: 200, ANALOG: 2000}, ["analog", "200 Hz", "2000 Hz"]),
        (
            {MARKERS: 119.88, TOOLS: 59.94, ANALOG: 2000, FORCE: 2000},
            ["3d", "59.9 Hz", "119.9 Hz", "analog and force", "2000 Hz"],
        ),
    ],
)
def test_the_cost_of_one_connection(rates_hz: Mapping[ComponentType, float], cost: list[str]) -> None:
    plan = plan_streams(announcing(rates_hz)).on_one_connection("why")
    assert plan.groups == (WIRE_ORDER,)
    assert names(plan.limitation, *cost, "why")


@pytest.mark.parametrize("not_a_rate", [0.0, -1.0, 1e-30, 1e30])
def test_a_number_that_cannot_be_a_rate_is_none(not_a_rate: float) -> None:
    parameters = announcing({MARKERS: not_a_rate, ANALOG: 2000})
    assert announced_rates_hz(parameters) == {ANALOG: 2000}
    assert plan_streams(parameters).groups == (WIRE_ORDER,)


TWO = (ComponentType.MARKERS, ComponentType.TOOLS)


def texts(rate: Rate, components: Sequence[ComponentType], server_rate_hz: float | None) -> list[str]:
    return [str(request) for request in request_forms(rate, components, server_rate_hz)]


@pytest.mark.parametrize(
    ("rate", "components", "server_rate_hz", "forms"),
    [
        (AllFrames(), TWO, 100, ["AllFrames 3D 6D", "AllFrames", "FrequencyDivisor:1", ""]),
        (AllFrames(), WIRE_ORDER[::-1], None, ["AllFrames", "FrequencyDivisor:1", ""]),
        (Frequency(50), TWO, 200, ["Frequency:50 3D 6D", "Frequency:50", "FrequencyDivisor:4", ""]),
        (Frequency(50), TWO, None, ["Frequency:50 3D 6D", "Frequency:50", ""]),
        (Frequency(50), TWO, 0.0, ["Frequency:50 3D 6D", "Frequency:50", ""]),
        (Frequency(100), WIRE_ORDER, 100, ["Frequency:100", "FrequencyDivisor:1", ""]),
        (FrequencyDivisor(1), WIRE_ORDER, 100, ["FrequencyDivisor:1", ""]),
        (FrequencyDivisor(4), TWO, 200, ["FrequencyDivisor:4 3D 6D", "FrequencyDivisor:4", ""]),
    ],
)
def test_the_configured_rate_and_components_are_requested_first_and_simpler_forms_next(
    rate: Rate, components: Sequence[ComponentType], server_rate_hz: float | None, forms: list[str]
) -> None:
    """All components need no names; a frequency falls back to a divisor; no form is repeated."""
    assert texts(rate, components, server_rate_hz) == [f"StreamFrames {form}".strip() for form in forms]


@pytest.mark.parametrize(
    ("wanted_hz", "server_rate_hz", "divisor"),
    [(60, 100, 2), (70, 100, 1), (30, 100, 3), (0.5, 100, 200), (500, 100, 1)],
)
def test_the_divisor_is_the_nearest_one_and_at_least_1(
    wanted_hz: float, server_rate_hz: float, divisor: int
) -> None:
    assert f"StreamFrames FrequencyDivisor:{divisor}" in texts(Frequency(wanted_hz), TWO, server_rate_hz)


FRAME_S = 0.005


class Link:
    """A link that carries part of the full rate: at a higher rate, frames are late. Time is simulated."""

    def __init__(self, carries_halvings: int) -> None:
        self.control = LagControl(max_lag_s=0.05)
        self.carries_halvings = carries_halvings
        self.now_s = 0.0
        self.changes: list[tuple[float, int]] = []

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += FRAME_S
            late = self.control.halvings < self.carries_halvings
            if self.control.observe(self.now_s, 0.2 if late else 0.001):
                self.changes.append((self.now_s, self.control.halvings))


@pytest.mark.parametrize(
    ("carries_halvings", "seconds", "num_changes"), [(0, 1000, 0), (3, 5, 3), (100, 1000, MAX_HALVINGS)]
)
def test_the_rate_is_halved_until_frames_arrive_in_time_or_the_limit(
    carries_halvings: int, seconds: float, num_changes: int
) -> None:
    link = Link(carries_halvings)
    link.run(seconds)
    assert [halvings for _, halvings in link.changes] == list(range(1, num_changes + 1))


def test_lateness_of_less_than_a_second_does_not_change_the_rate() -> None:
    link = Link(carries_halvings=1)
    for _ in range(20):
        for link.carries_halvings, seconds in ((1, 0.9), (0, 0.1)):
            link.run(seconds)
    assert link.changes == []


def test_the_rate_returns_to_the_configured_one_by_steps_of_ten_seconds() -> None:
    link = Link(carries_halvings=2)
    link.run(5)
    link.carries_halvings = 0
    link.run(100)
    assert [halvings for _, halvings in link.changes] == [1, 2, 1, 0]
    assert link.changes[2][0] - link.changes[1][0] == pytest.approx(FIRST_WAIT_S, abs=0.1)


def test_the_wait_after_failed_steps_up_doubles_to_five_minutes() -> None:
    link = Link(carries_halvings=1)
    link.run(4000)
    ups = [time_s for time_s, halvings in link.changes if halvings == 0]
    waits = [round(later - earlier) for earlier, later in pairwise(ups)]
    assert waits == sorted(waits)
    assert waits[0] == pytest.approx(2 * FIRST_WAIT_S, abs=2)
    assert waits[-1] == pytest.approx(MAX_WAIT_S, abs=2)
    assert all(halvings <= 1 for _, halvings in link.changes)


def test_a_step_up_that_lasts_resets_the_wait() -> None:
    link = Link(carries_halvings=1)
    link.run(200)
    assert link.control.wait_s > FIRST_WAIT_S
    link.carries_halvings = 0
    link.run(1000)
    link.carries_halvings = 1
    link.run(2)
    assert link.control.wait_s == FIRST_WAIT_S


@pytest.mark.parametrize(
    ("rate", "halvings", "expected"),
    [
        (AllFrames(), 2, FrequencyDivisor(4)),
        (None, 2, FrequencyDivisor(4)),
        (FrequencyDivisor(3), 2, FrequencyDivisor(12)),
        (Frequency(60), 2, Frequency(15)),
        (AllFrames(), 5, FrequencyDivisor(32)),
        (FrequencyDivisor(3), 5, FrequencyDivisor(96)),
        (Frequency(64), 5, Frequency(2)),
    ],
)
def test_a_rate_is_halved_several_times(rate: Rate | None, halvings: int, expected: Rate) -> None:
    assert halved(rate, halvings) == expected
    assert halved(rate, 0) == rate


RESTART = None
LATE, GOOD = 0.2, 0.0


@pytest.mark.parametrize(
    ("observed", "changes_s", "halvings"),
    [
        pytest.param(
            [(0.0, LATE), RESTART, (0.5, LATE), (1.25, LATE), (1.5, LATE)],
            [1.5],
            1,
            id="a restart forgets that frames were late",
        ),
        pytest.param(
            [(0, LATE), (1, LATE), (2, GOOD), RESTART, (11, GOOD), (20.9, GOOD), (21, GOOD)],
            [1.0, 21.0],
            0,
            id="after a restart frames must be in time for the whole wait again",
        ),
        pytest.param(
            [(0, LATE), (1, LATE), (2, LATE), (3, GOOD), (13, GOOD), (23, GOOD)],
            [1.0, 2.0, 13.0, 23.0],
            0,
            id="the second step up comes exactly one wait after the first",
        ),
    ],
)
def test_when_the_rate_changes(
    observed: list[tuple[float, float] | None], changes_s: list[float], halvings: int
) -> None:
    control, changed_s = LagControl(max_lag_s=0.05), []
    for each in observed:
        if each is None:
            control.restart()
            assert control.is_late is False
        elif control.observe(*each):
            changed_s.append(each[0])
    assert (changed_s, control.halvings) == (changes_s, halvings)
