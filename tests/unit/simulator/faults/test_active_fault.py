"""The times at which faults begin."""

import numpy as np
import pytest

from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.stream_faults import Delay, Jitter
from tests.unit.simulator.faults.faulty_packets import active, writes_for


def delays_s(fault: Fault, seed: int) -> list[float]:
    planned = active(fault, seed)
    return [planned.first_delay_s(), *(planned.random_interval_s(fault.every_s or 0.0) for _ in range(200))]


def test_a_repeated_fault_begins_at_random_intervals_that_are_the_same_for_the_same_seed() -> None:
    fault = Delay(every_s=4, for_s=1)
    first = delays_s(fault, 1)

    assert all(2 <= delay_s <= 6 for delay_s in first)
    assert np.mean(first) == pytest.approx(4, rel=0.1)
    assert first == delays_s(fault, 1)
    assert first != delays_s(fault, 2)


def test_when_a_fault_begins_does_not_depend_on_how_many_packets_it_changed() -> None:
    fault = Jitter(every_s=4, for_s=1)
    idle, busy = active(fault), active(fault)
    for _ in range(10):
        writes_for(fault, b"x", busy)
    assert idle.first_delay_s() == busy.first_delay_s()


def test_a_fault_first_begins_at_its_time_or_at_once() -> None:
    assert active(Delay(at_s=3, every_s=5, for_s=1)).first_delay_s() == 3
    assert active(Delay()).first_delay_s() == 0
