"""When the parameters are read again, in virtual time."""

import asyncio

from gateway.config.settings import SourceSettings
from gateway.queries.parameter_refresh import ParameterRefresh


async def test_an_answer_for_another_reason_delays_the_next_reading() -> None:
    """So the server is not asked for what it has just sent."""
    loop = asyncio.get_running_loop()
    started_s, readings_s = loop.time(), list[int]()

    async def read() -> None:
        readings_s.append(round(loop.time() - started_s))

    settings = SourceSettings(name="lab", host="192.0.2.1", parameters_interval_s=10.0)
    refresh = ParameterRefresh(settings, read, lambda: started_s + 4.0)
    task = asyncio.create_task(refresh.run())
    await asyncio.sleep(30.0)
    task.cancel()
    assert readings_s == [14, 24]
