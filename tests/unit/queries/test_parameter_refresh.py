"""When the parameters are read again, in virtual time."""

import asyncio
from typing import Any

from gateway.config.settings import SourceSettings
from gateway.queries.parameter_refresh import ParameterRefresh
from tests.virtual_time import run_in_virtual_time


async def readings_s(request_s: float, **settings: Any) -> list[int]:
    """Return the times of all readings, with a request at one time, and another reading after 4 s."""
    loop = asyncio.get_running_loop()
    started_s, readings_s = loop.time(), list[int]()

    async def read() -> None:
        readings_s.append(round(loop.time() - started_s))
        if len(readings_s) > 9:
            task.cancel()  # time would stand still

    source_settings = SourceSettings(name="lab", host="192.0.2.1", **settings)
    refresh = ParameterRefresh(source_settings, read, lambda: started_s + 4.0)
    task = asyncio.create_task(refresh.run())
    loop.call_later(request_s, refresh.request)
    await asyncio.sleep(30.0)
    task.cancel()
    return readings_s


def test_an_answer_for_another_reason_delays_the_next_reading() -> None:
    """So the server is not asked for what it has just sent."""
    assert run_in_virtual_time(readings_s(99.0, parameters_interval_s=10.0)) == [14, 24]


def test_without_an_interval_the_parameters_are_read_on_request_only() -> None:
    assert run_in_virtual_time(readings_s(5.0, parameters_interval_s=0.0)) == [6]
