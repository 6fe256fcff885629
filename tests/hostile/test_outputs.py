"""Subscribers, routers and LCM peers that stop, are slow or declare without end: nobody else notices."""

import asyncio
import contextlib
import itertools
import signal
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest

from tests.gateway_process import simulator
from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.server_floods import EVENT, MARKERS, component, frame
from tests.hostile.servers import streaming
from tests.proxy import FuzzingProxy
from tests.servers import Client, ScriptedServer

pytestmark = pytest.mark.netns

NUM_MARKERS = 60_000

NUM_STALLED = 120
"""So many that they would be noticed if a message waited 20 ms for each of them."""


@pytest.fixture(scope="module")
def dense_server() -> Iterator[int]:
    """The port of a server that fills the buffers of a subscriber that does not read within a second."""
    with simulator("--markers", "1000", "--rate", "200", "--analog-rate", "200") as (port, _):
        yield port


@asynccontextmanager
async def zenoh_peer(kind: str, endpoint: str, count: int) -> AsyncIterator[Process]:
    """Run tests/hostile/zenoh_peer.py until the end of the block."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.hostile.zenoh_peer", kind, endpoint, str(count)),
        stdin=PIPE,
        stdout=PIPE,
        stderr=DEVNULL,  # Zenoh's log
    )
    try:
        yield process
    finally:
        process.kill()
        await process.wait()


async def done(process: Process) -> None:
    """Wait until the peer has done all that it does."""
    assert process.stdout is not None
    assert await process.stdout.readline() == b"done\n"


async def test_subscribers_that_stop_reading(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"dense": dense_server}) as gateway:
        async with zenoh_peer("subscribers", gateway.zenoh_endpoint, NUM_STALLED) as stalled:
            await done(stalled)
            stalled.send_signal(signal.SIGSTOP)
            await asyncio.sleep(2)
            stalled.send_signal(signal.SIGCONT)
            await asyncio.sleep(0.5)
            stalled.send_signal(signal.SIGSTOP)
        await asyncio.sleep(0.5)  # killed
    gateway.report.check()


LCM_RECEIVER = """
import sys
from gateway.outputs.lcm.connection import open_lcm
receiver = open_lcm(sys.argv[1])
receiver.subscribe(".*", lambda channel, message: None)
print("done", flush=True)
while True:
    receiver.handle()
"""


@asynccontextmanager
async def lcm_receiver(url: str) -> AsyncIterator[Process]:
    """Run a receiver of everything until the end of the block."""
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", LCM_RECEIVER, url, stdout=PIPE)
    try:
        yield process
    finally:
        process.kill()
        await process.wait()


async def test_routers_and_lcm_receivers_that_stop(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"dense": dense_server}) as gateway:
        for _ in range(2):  # restarted once
            async with (
                zenoh_peer("routers", gateway.zenoh_endpoint, 1) as router,
                lcm_receiver(f"{gateway.lcm_url}&recv_buf_size=4096") as receiver,
            ):
                await asyncio.gather(done(router), done(receiver))
                router.send_signal(signal.SIGSTOP)
                receiver.send_signal(signal.SIGSTOP)
                await asyncio.sleep(1)
    gateway.report.check()


async def test_subscribers_behind_a_slow_link(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"dense": dense_server}) as gateway:
        port = int(gateway.zenoh_endpoint.rpartition(":")[2])
        async with (
            FuzzingProxy(port) as slow,
            FuzzingProxy(port) as slower,
            zenoh_peer("subscribers", f"tcp/127.0.0.1:{slow.port}", 3) as first,
            zenoh_peer("subscribers", f"tcp/127.0.0.1:{slower.port}", 2) as second,
        ):
            await asyncio.gather(done(first), done(second))
            slow.to_client.bytes_per_s = 2_000_000
            slower.to_client.bytes_per_s = 10_000
            await asyncio.sleep(3)
    gateway.report.check()


async def huge_frames(client: Client) -> None:
    """Send frames with as many markers as can be converted to JSON, and bursts of events."""
    items = bytes(16 * NUM_MARKERS)
    for number in itertools.count(100):
        client.send(frame(component(MARKERS, number, 50_000 * number, NUM_MARKERS, items)))
        for event in range(20):
            client.send(frame(component(EVENT, number, 50_000 * number + event, 500, bytes(24 * 500))))
        await client.drain()
        await asyncio.sleep(0.05)


async def test_json_of_huge_frames(gateway_under_attack: GatewayUnderAttack) -> None:
    """Converting all of it would take several processor cores."""
    async with (
        ScriptedServer(streaming(huge_frames)) as server,
        gateway_under_attack({"huge": server.port}) as gateway,
        zenoh_peer("json", gateway.zenoh_endpoint, 3) as peer,
    ):
        await done(peer)
        await asyncio.sleep(4)
    gateway.report.check()


async def test_peers_that_flood(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        endpoint = gateway.zenoh_endpoint
        async with (
            zenoh_peer("connections", endpoint, 300) as first,
            zenoh_peer("keys", endpoint, 10_000) as second,
            zenoh_peer("tokens", endpoint, 5_000) as third,
            zenoh_peer("puts", endpoint, 100_000) as fourth,
        ):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.gather(*map(done, (first, second, third, fourth))), 5)
    gateway.report.check()
