"""Which components share a connection, by the rates that a server announces."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

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
from gateway.stream.plan import StreamPlan, announced_rates_hz, plan_streams

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
        ({MARKERS: 200, ANALOG: 2000}, "analog arrives at 200 Hz instead of 2000 Hz"),
        (
            {MARKERS: 119.88, TOOLS: 59.94, ANALOG: 2000, FORCE: 2000},
            "3d arrives at 59.9 Hz instead of 119.9 Hz, analog and force instead of 2000 Hz",
        ),
    ],
)
def test_the_cost_of_one_connection(rates_hz: Mapping[ComponentType, float], cost: str) -> None:
    plan = plan_streams(announcing(rates_hz)).on_one_connection("why")
    assert (plan.groups, plan.limitation) == ((WIRE_ORDER,), f"{cost}: why")


@pytest.mark.parametrize("not_a_rate", [0.0, -1.0, 1e-30, 1e30])
def test_a_number_that_cannot_be_a_rate_is_none(not_a_rate: float) -> None:
    parameters = announcing({MARKERS: not_a_rate, ANALOG: 2000})
    assert announced_rates_hz(parameters) == {ANALOG: 2000}
    assert plan_streams(parameters).groups == (WIRE_ORDER,)
