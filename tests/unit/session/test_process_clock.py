"""Time-outs that do not count the time during which the process is stopped."""

import asyncio

import pytest

from gateway.session.process_clock import RunningTimeout, running_clock
from tests.support.clocks import stop_process


def now_s() -> float:
    return asyncio.get_running_loop().time()


async def test_while_the_process_runs_the_clock_runs_like_any_other() -> None:
    clock, began_s = running_clock(), now_s()
    before_s = clock.time()
    for seconds in (0.05, 0.1, 0.33, 60.0):
        await asyncio.sleep(seconds)
        assert clock.time() - before_s == pytest.approx(now_s() - began_s)


@pytest.mark.parametrize("stop_s", [0.3, 2.0, 5.0, 86_400.0])
async def test_a_stop_of_the_process_counts_almost_nothing(stop_s: float) -> None:
    clock = running_clock()
    await asyncio.sleep(1)
    before_s = clock.time()
    stop_process(stop_s)
    assert clock.time() - before_s <= 0.2
    await asyncio.sleep(1)
    assert 1.0 <= clock.time() - before_s <= 1.2 + 1e-9


async def test_the_clock_never_goes_back() -> None:
    clock = running_clock()
    times_s = []
    for seconds in (0.05, 3.0, 0.01, 0.15, 0.0):
        times_s.append(clock.time())
        stop_process(seconds)
        times_s.append(clock.time())
        await asyncio.sleep(0)
    assert times_s == sorted(times_s)


async def test_the_longest_delay_of_the_last_half_minute_is_known() -> None:
    """It shows whether this gateway or the server caused a gap."""
    clock = running_clock()
    await asyncio.sleep(1)
    assert clock.longest_delay_s() == 0
    stop_process(3.0)
    assert clock.longest_delay_s() == pytest.approx(3.0, abs=0.11)  # before any timer
    await asyncio.sleep(1)
    stop_process(0.5)
    await asyncio.sleep(1)
    assert clock.longest_delay_s() == pytest.approx(3.0, abs=0.11)
    await asyncio.sleep(28)
    assert clock.longest_delay_s() == pytest.approx(0.5, abs=0.11)
    await asyncio.sleep(5)
    assert clock.longest_delay_s() == 0


async def test_callbacks_that_tick_save_the_timer_all_its_wake_ups() -> None:
    """At 200 Hz, its ten wake-ups a second would cost 5 % more."""
    clock, timers = running_clock(), set()
    for _ in range(200):
        await asyncio.sleep(0.005)
        clock.tick()
        timers.add(clock._timer)
    assert all(timer.cancelled() for timer in timers - {clock._timer})
    assert len(timers) <= 1 + 1.0 / 0.05


async def test_each_event_loop_has_one_clock() -> None:
    clock = running_clock()
    assert running_clock() is clock

    async def other() -> object:
        return running_clock()

    assert await asyncio.to_thread(asyncio.run, other()) is not clock
    assert running_clock() is clock


async def test_a_timeout_ends_after_its_time() -> None:
    began_s = now_s()
    with pytest.raises(TimeoutError):
        async with RunningTimeout(2.0):
            await asyncio.sleep(10)
    assert now_s() - began_s == pytest.approx(2.0, abs=0.01)


async def test_what_ends_in_time_is_not_disturbed_and_its_errors_are_raised() -> None:
    async def fail() -> None:
        async with RunningTimeout(2.0):
            await asyncio.sleep(1.9)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await fail()
    await asyncio.sleep(10)


async def test_a_stop_of_the_process_is_not_part_of_a_timeout() -> None:
    async def wait() -> float:
        with pytest.raises(TimeoutError):
            async with RunningTimeout(2.0):
                await asyncio.sleep(100)
        return now_s()

    waiting = asyncio.create_task(wait())
    await asyncio.sleep(1)
    stop_process(30)
    continued_s = now_s()
    assert 0.8 <= await waiting - continued_s <= 1.01
