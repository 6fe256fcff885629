"""VRPN clients of a whole gateway: the real libvrpn, and a client that shows the bytes."""

import asyncio
import contextlib
import json
import math
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.daemon.gateway import Gateway
from gateway.outputs.adapters.vrpn.output import VrpnOutput
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from tests.support.configurations import local_settings, local_source
from tests.support.gateways import running_gateway
from tests.support.needs import need
from tests.support.networks import free_port
from tests.support.servers import ToolServer
from tests.support.waiting import wait_until_async

Poses = dict[str, list[float]]


@contextlib.asynccontextmanager
async def served(servers: Mapping[str, int], *, port: int = 0, **settings: Any) -> AsyncIterator[int]:
    """Run a gateway for these servers, by the source's name; yield the port of its VRPN server.

    ``settings`` are those of each source.
    """
    port = port or free_port()
    sources = (
        local_source(server_port, name, parameters_interval_s=0.1, **settings)
        for name, server_port in servers.items()
    )
    output = VrpnOutput(VrpnSettings(enabled=True, port=port))
    async with running_gateway(Gateway(local_settings(*sources), [output])):
        await wait_until_async(lambda: output.health().connected)
        yield port


HAS_PROTOCOLS = Path("/etc/protocols").exists()


class LibVrpn:
    """The real libvrpn in a process of its own."""

    def __init__(self) -> None:
        self.poses: Poses = {}
        """The newest pose of each tracker."""
        self.num_lines = 0

    async def read(self, stdout: asyncio.StreamReader) -> None:
        async for line in stdout:
            if line.startswith(b"{"):  # libvrpn prints, too
                self.poses.update(json.loads(line))
                self.num_lines += 1

    async def wait_for(self, condition: Callable[[Poses], object]) -> None:
        await wait_until_async(lambda: condition(self.poses))


@contextlib.asynccontextmanager
async def libvrpn(address: str) -> AsyncIterator[LibVrpn]:
    need(HAS_PROTOCOLS, "libvrpn reads /etc/protocols: install Debian's netbase")
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.support.vrpn_oracle", address), stdout=PIPE, limit=1 << 20
    )
    assert process.stdout is not None
    client = LibVrpn()
    reading = asyncio.create_task(client.read(process.stdout))
    try:
        yield client
    finally:
        process.kill()
        await process.wait()
        await reading


@pytest.mark.parametrize("scheme", ["", "tcp://"])
async def test_libvrpn_gets_names_metres_and_the_scalar_last_in_the_frame_of_the_source(scheme: str) -> None:
    server = ToolServer(["wand", "Left Foot"], unit="cm")
    server.tools = [
        (0.5, -0.5, 0.5, 0.5, 150.0, -25.0, 0.3, 0.1),
        (1.0, 0.0, 0.0, 0.0, 100.0, 200.0, 300.0, 0.1),
    ]
    transform = {"up": "y", "translation_m": [10.0, 0.0, 0.0]}
    async with (
        server,
        served({"lab": server.port}, transform=transform) as port,
        libvrpn(f"{scheme}127.0.0.1:{port}") as client,
    ):
        await client.wait_for(lambda poses: len(poses) == 2)
    half = math.sqrt(0.5)
    assert client.poses == {
        "wand": pytest.approx([11.5, -0.003, -0.25, 0.0, 0.0, half, half]),
        "Left_Foot": pytest.approx([11.0, -3.0, 2.0, half, 0.0, 0.0, half]),
    }


async def test_libvrpn_follows_tools_that_return_change_names_and_are_added() -> None:
    server = ToolServer(["wand", "foot"])
    server.tools[1] = None
    async with (
        server,
        served({"lab": server.port}) as port,
        libvrpn(f"127.0.0.1:{port}") as client,
    ):
        await client.wait_for(lambda poses: "wand" in poses)
        num_lines = client.num_lines
        await wait_until_async(lambda: client.num_lines > num_lines + 5)
        assert list(client.poses) == ["wand"]
        server.tools[1] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 7000.0, 0.1)
        await client.wait_for(lambda poses: "foot" in poses)
        server.labels = ["wand", "hand", "probe"]
        server.tools.append((1.0, 0.0, 0.0, 0.0, 9000.0, 0.0, 0.0, 0.1))
        await client.wait_for(lambda poses: poses.keys() >= {"hand", "probe"})
        client.poses.clear()
        await client.wait_for(lambda poses: len(poses) == 3)
        assert client.poses.keys() == {"wand", "hand", "probe"}
        assert client.poses["hand"][2] == pytest.approx(7.0)
        assert client.poses["probe"][0] == pytest.approx(9.0)


async def test_libvrpn_connects_again_when_the_gateway_returns() -> None:
    """Then with two sources and another client."""
    async with ToolServer(["wand"]) as lab, ToolServer(["wand", "foot"]) as stage:
        port = free_port()
        async with contextlib.AsyncExitStack() as stack:
            async with served({"lab": lab.port}, port=port):
                client = await stack.enter_async_context(libvrpn(f"127.0.0.1:{port}"))
                await client.wait_for(lambda poses: poses)
            async with served({"lab": lab.port, "stage": stage.port}, port=port):
                other = await stack.enter_async_context(libvrpn(f"127.0.0.1:{port}"))
                for each in (client, other):
                    await each.wait_for(
                        lambda poses: poses.keys() >= {"lab/wand", "stage/wand", "stage/foot"}
                    )
