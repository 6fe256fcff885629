"""A whole gateway with an output in memory, for tests against any server."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from gateway.config.settings import MetricsSettings, ReconnectSettings, SourceSettings
from gateway.gateway import Gateway
from gateway.messages.decode import decode
from gateway.outputs.memory import MemoryOutput
from tests.configurations import make_settings
from tests.waiting import wait_until_async


class Running:
    """A gateway of one source that publishes into memory."""

    def __init__(self, gateway: Gateway, output: MemoryOutput) -> None:
        self.gateway = gateway
        self.output = output
        [self.source] = gateway.sources
        self.status = self.source.statuses[0]

    def messages(self, component: str) -> list[Any]:
        return [decode(data) for topic, data in self.output.messages if topic.path == (component,)]

    async def until(self, condition: Callable[[], object]) -> None:
        await wait_until_async(condition)

    async def heard(self, component: str, count: int = 1) -> list[Any]:
        await self.until(lambda: len(self.messages(component)) >= count)
        return self.messages(component)


@asynccontextmanager
async def gateway_to(port: int, **settings: Any) -> AsyncIterator[Running]:
    """Run a gateway of the source "lab" on a port of this machine; ``settings`` are the source's.

    It tries again at once, and waits shortly for replies.
    """
    source: dict[str, Any] = {
        "name": "lab",
        "host": "127.0.0.1",
        "port": port,
        "reconnect": ReconnectSettings(first_delay_s=0.01, max_delay_s=0.05),
        "reply_timeout_s": 0.3,
        "stall_timeout_s": 1.0,
    }
    output = MemoryOutput()
    unwatched = MetricsSettings(enabled=False)
    gateway = Gateway(
        make_settings(sources=(SourceSettings(**(source | settings)),), metrics=unwatched), [output]
    )
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    try:
        yield Running(gateway, output)
    finally:
        stop.set()
        async with asyncio.timeout(5):
            await task
