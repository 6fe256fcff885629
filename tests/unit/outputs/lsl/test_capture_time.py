"""Capture times on LSL's clock, while somebody sets the wall clock."""

import time

import pytest

from gateway.messages.host_time import HostClock, now_steady_us
from gateway.messages.stamp import Stamp
from gateway.outputs.lsl.capture_time import CaptureTimes, SuspendedTime

DELAY_US = 3_000


def arriving(clock: HostClock, age_us: int = 0) -> tuple[Stamp, int]:
    """Return the stamp of a frame that arrived ``age_us`` ago by the present wall clock, and when, steady."""
    arrived_us = now_steady_us() - age_us
    utime = arrived_us + clock.offset_us
    return Stamp(utime, utime - DELAY_US, 1, 1), arrived_us


def test_a_capture_time_is_the_wall_clock_minus_its_offset() -> None:
    clock = HostClock()
    stamp, arrived_us = arriving(clock)
    assert CaptureTimes(clock).steady_us(stamp) == arrived_us - DELAY_US


@pytest.mark.parametrize("step_s", [3600, -3600, 0.5, -0.5])
def test_a_step_of_the_wall_clock_does_not_move_capture_times(step_s: float) -> None:
    clock = HostClock()
    times = CaptureTimes(clock)
    waiting, waiting_us = arriving(clock, age_us=2_000)  # arrived before the step, and is published after it
    clock.offset_us += int(step_s * 1e6)
    revealing, revealing_us = arriving(clock)  # its arrival has revealed the step
    assert times.steady_us(revealing) == revealing_us - DELAY_US
    assert times.steady_us(waiting) == waiting_us - DELAY_US
    later, later_us = arriving(clock)
    assert times.steady_us(later) == later_us - DELAY_US


def test_only_a_suspension_moves_the_steady_clock_against_the_monotonic_one() -> None:
    suspended = SuspendedTime()
    difference_us = suspended.read_us()
    assert abs(now_steady_us() - time.monotonic_ns() // 1000 - difference_us) < 1_000_000
    suspended._measured_s -= 10  # as if a second had passed
    assert suspended.read_us() == difference_us
    suspended._us -= 5_000_000  # as if the computer had slept for 5 s since then
    suspended._measured_s -= 10
    assert abs(suspended.read_us() - difference_us) < 1_000
