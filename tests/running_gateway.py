"""Running a gateway in the event loop of a test."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from gateway.gateway import Gateway


@asynccontextmanager
async def running_gateway(gateway: Gateway, stop_timeout_s: float = 20) -> AsyncIterator[Gateway]:
    """Run a gateway during the block; after that, it must stop within ``stop_timeout_s``."""
    stop = asyncio.Event()
    task = asyncio.create_task(gateway.run(stop))
    try:
        yield gateway
    finally:
        stop.set()
        async with asyncio.timeout(stop_timeout_s):
            await task
