"""Running a gateway in the event loop of a test."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from gateway.service.gateway import Gateway
from gateway.service.monitoring.server import MonitoringServer

_STOP_TIMEOUT_S: Final = 60.0


@asynccontextmanager
async def running_gateway(gateway: Gateway) -> AsyncIterator[Gateway]:
    """Run a gateway during the block; after that, it must stop."""
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    try:
        yield gateway
    finally:
        stop.set()
        async with asyncio.timeout(_STOP_TIMEOUT_S):
            await task


@asynccontextmanager
async def monitored_gateway(gateway: Gateway) -> AsyncIterator[Gateway]:
    """Run a gateway, and the server of its metrics and its health, during the block."""
    monitoring = MonitoringServer(gateway.settings.metrics, gateway)
    async with running_gateway(gateway):
        await monitoring.start()
        try:
            yield gateway
        finally:
            await monitoring.close()
