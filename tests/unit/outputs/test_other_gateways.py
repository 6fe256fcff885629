"""Other gateways that publish a source of the same name."""

import logging

import pytest

from gateway.outputs.other_gateways import HOLD_S, MAX_OTHERS, OtherGateways
from tests.support.clocks import Clock


def test_another_gateway_is_logged_once_and_shown_until_it_is_gone(caplog: pytest.LogCaptureFixture) -> None:
    """At first, it may be the former session of this gateway, which is just closing."""
    caplog.set_level(logging.INFO)
    clock = Clock()
    others = OtherGateways("zenoh", monotonic=clock)
    others.seen("lab", "a")
    others.seen("hall", "b")
    others.check()
    assert others.warnings == []
    others.gone("hall", "b")
    clock.now_s += HOLD_S
    for _ in range(3):
        others.check()
    [warning] = others.warnings
    assert warning.startswith("lab: ")
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    others.gone("lab", "a")
    others.check()
    assert others.warnings == []
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.INFO]


def test_one_that_shows_itself_no_more_is_forgotten() -> None:
    """On LCM, nobody says that a gateway has gone."""
    clock = Clock()
    others = OtherGateways("lcm", 15.0, clock)
    for _ in range(4):
        others.seen("lab", "a")
        clock.now_s += 5
    assert others.warnings
    clock.now_s += 15
    assert others.warnings == []
    others.seen("lab", "a")
    clock.now_s += HOLD_S
    assert others.warnings
    others.forget("lab")
    assert others.warnings == []


def test_whoever_claims_to_be_many_gateways_fills_no_memory() -> None:
    clock = Clock()
    others = OtherGateways("lcm", 15.0, clock)
    for number in range(10 * MAX_OTHERS):
        others.seen("lab", str(number))
    clock.now_s += HOLD_S
    assert len(others._others["lab"]) == MAX_OTHERS
    assert str(MAX_OTHERS) in others.warnings[0]
