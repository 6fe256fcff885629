import random

import pytest

from gateway.replay.pace import Lateness, Pace


def test_positions_are_due_on_an_absolute_schedule() -> None:
    now_s = 100.0
    pace = Pace(2.0, lambda: now_s)
    pace.start(10_000_000)
    assert pace.due_s(10_000_000) == pytest.approx(100.0)
    now_s = 105.0  # however late a message was, the next one is due as planned
    assert pace.due_s(14_000_000) == pytest.approx(102.0)
    assert pace.due_s(3_610_000_000) == pytest.approx(1900.0)


def test_a_pause_moves_everything() -> None:
    pace = Pace(0.5, lambda: 100.0)
    pace.start(0)
    pace.shift(7.0)
    assert pace.due_s(1_000_000) == pytest.approx(109.0)


def test_quantiles_of_the_lateness_are_right_within_2_percent() -> None:
    choice = random.Random(1)
    late = Lateness()
    values = [choice.lognormvariate(-8, 2) for _ in range(20_000)]
    for value in values:
        late.add(value)
    values.sort()
    for fraction in (0.5, 0.9, 0.99, 0.999):
        assert late.quantile_s(fraction) == pytest.approx(values[int(fraction * len(values)) - 1], rel=0.03)
    assert late.max_s == values[-1]
    assert late.quantile_s(1.0) == late.max_s


def test_lateness_has_no_limits() -> None:
    late = Lateness()
    assert late.quantile_s(0.99) == 0.0
    for value in (0.0, 1e-9, 1e9):
        late.add(value)
    assert late.quantile_s(0.1) <= 1.1e-6
    assert late.max_s == 1e9
