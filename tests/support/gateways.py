"""Gateways in the event loop of a test: any, one that publishes into memory, and one that serves clients."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any, Final, Protocol

from gateway.daemon.gateway import Gateway
from gateway.daemon.monitoring.server import MonitoringServer
from gateway.messages.decode import decode
from gateway.outputs.adapters.rtc3d.live_server import LiveServer
from gateway.outputs.adapters.rtc3d.output import Rtc3dOutput
from gateway.outputs.adapters.rtc3d.settings import Rtc3dSettings
from gateway.outputs.contract import Output
from gateway.simulator.simulator import Simulator
from tests.support.configurations import local_settings, local_source
from tests.support.memory_output import MemoryOutput
from tests.support.networks import free_port
from tests.support.waiting import wait_until_async
from tests.unit.session.server.counting_scene import CountingScene

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


class Server(Protocol):
    port: int


class ServingGateway:
    """A running gateway with the source "lab", whose clients connect to ``port`` of this host."""

    def __init__(self, gateway: Gateway, output: Rtc3dOutput, port: int) -> None:
        self.gateway = gateway
        self.output = output
        self.port = port

    @property
    def source(self) -> Any:
        [source] = self.gateway.sources
        return source

    @property
    def server(self) -> LiveServer:
        server = self.output._served["lab"].server
        assert server is not None
        return server


@asynccontextmanager
async def serving_gateway(
    server: Server,
    *,
    outputs: Sequence[Output] = (),
    is_streaming: bool = True,
    **source: Any,
) -> AsyncIterator[ServingGateway]:
    """Run a gateway in front of ``server``; ``source`` replaces settings of the source.

    Wait until frames arrive, if ``is_streaming``; otherwise only until clients can connect.
    """
    port = free_port()
    output = Rtc3dOutput(Rtc3dSettings(enabled=True, ports={"lab": port}))
    gateway = Gateway(local_settings(local_source(server.port, **source)), [output, *outputs])
    async with running_gateway(gateway):
        served = ServingGateway(gateway, output, port)
        await wait_until_async(lambda: output.health().connected)
        if is_streaming:
            await wait_until_async(lambda: all(status.frames_in for status in served.source.statuses))
        yield served


@asynccontextmanager
async def playing(scene: Any = None, **settings: Any) -> AsyncIterator[tuple[Simulator, ServingGateway]]:
    """Run a simulator and a gateway in front of it."""
    async with (
        Simulator(scene or CountingScene()) as simulator,
        serving_gateway(simulator, **settings) as gateway,
    ):
        yield simulator, gateway
