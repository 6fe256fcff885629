"""A gateway that serves RTC3D clients, in front of any RT server."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any, Protocol

from gateway.outputs.contract import Output
from gateway.outputs.rtc3d.live_server import LiveServer
from gateway.outputs.rtc3d.output import Rtc3dOutput
from gateway.outputs.rtc3d.settings import Rtc3dSettings
from gateway.service.gateway import Gateway
from gateway.simulator.simulator import Simulator
from tests.configurations import local_settings, local_source
from tests.networks import free_port
from tests.running_gateway import running_gateway
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.waiting import wait_until_async


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
