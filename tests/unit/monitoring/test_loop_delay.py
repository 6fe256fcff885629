import asyncio
import time

from gateway.monitoring.loop_delay import LoopDelay
from tests.waiting import wait_until_async


def test_the_largest_delay_expires_after_one_to_two_minutes() -> None:
    delay = LoopDelay()
    largest = []
    for now_s, delay_s in ((0.0, 0.0), (59.0, 0.5), (61.0, 0.1), (119.0, 0.2), (121.5, 0.0), (182.0, 0.0)):
        delay.record(now_s, delay_s)
        assert delay.last_s == delay_s
        largest.append(delay.max_s)
    assert largest == [0.0, 0.5, 0.5, 0.5, 0.2, 0.0]


async def test_a_blocked_event_loop_is_measured() -> None:
    delay = LoopDelay()
    delay.start()
    await asyncio.sleep(0)
    time.sleep(0.3)  # noqa: ASYNC251 - blocks the loop on purpose, 0.2 s past the timer
    await wait_until_async(lambda: delay.max_s >= 0.2)
    delay.close()


async def test_closing_stops_the_measurement() -> None:
    delay = LoopDelay()
    delay.start()
    await wait_until_async(lambda: delay.last_s > 0)
    delay.close()
    assert delay._timer is not None
    assert delay._timer.cancelled()
