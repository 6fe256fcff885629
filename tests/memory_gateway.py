"""A whole gateway that publishes into memory, for tests against any server."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from gateway.messages.decode import decode
from gateway.service.gateway import Gateway
from tests.configurations import local_settings, local_source
from tests.memory_output import MemoryOutput
from tests.running_gateway import running_gateway
from tests.waiting import wait_until_async


class MemoryGateway:
    """A running gateway with one source and a MemoryOutput."""

    def __init__(self, gateway: Gateway, output: MemoryOutput) -> None:
        self.gateway = gateway
        self.output = output
        [self.source] = gateway.sources
        self.status = self.source.statuses[0]

    def messages(self, component: str) -> list[Any]:
        """Return the decoded messages of a component that were published so far."""
        return [decode(data) for topic, data in self.output.messages if topic.path == (component,)]

    async def wait_until(self, condition: Callable[[], object]) -> None:
        await wait_until_async(condition)

    async def wait_for(self, component: str, count: int = 1) -> list[Any]:
        """Wait for at least ``count`` messages of a component, and return all of them."""
        await self.wait_until(lambda: len(self.messages(component)) >= count)
        return self.messages(component)


@asynccontextmanager
async def run_gateway(port: int, **settings: Any) -> AsyncIterator[MemoryGateway]:
    """Run a gateway with the source "lab", whose server listens on ``port`` of this host.

    It reconnects at once, and waits so long for replies and frames that only a defect ends a connection.
    ``settings`` replaces settings of the source.
    """
    timeouts = {"reply_timeout_s": 60.0, "stall_timeout_s": 60.0}
    output = MemoryOutput()
    gateway = Gateway(local_settings(local_source(port, **(timeouts | settings))), [output])
    async with running_gateway(gateway):
        yield MemoryGateway(gateway, output)
