"""Subscribers, routers and LCM peers that stop, are slow or declare without end: nobody else notices."""

import asyncio
import contextlib
import itertools
import json
import signal
from asyncio.subprocess import DEVNULL, Process
from contextlib import AbstractAsyncContextManager
from typing import Any, Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, printed, python
from tests.hostile.server_floods import EVENT, MARKERS, component, frame
from tests.hostile.servers import streaming
from tests.support.networks import free_endpoint, zenoh_keys
from tests.support.proxy import FuzzingProxy
from tests.support.servers import Client, ScriptedServer
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

NUM_MARKERS: Final = 60_000
NUM_STALLED: Final = 120
"""So many that they would be noticed if a message waited 20 ms for each of them."""


def zenoh_peer(kind: str, endpoint: str, count: int) -> AbstractAsyncContextManager[Process]:
    """Run tests/hostile/zenoh_peer.py until the end of the block."""
    return python("-m", "tests.hostile.zenoh_peer", kind, endpoint, str(count), stderr=DEVNULL)  # Zenoh's log


async def test_subscribers_that_stop_reading(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"dense": dense_server}) as gateway:
        async with zenoh_peer("subscribers", gateway.zenoh_endpoint, NUM_STALLED) as stalled:
            await printed(stalled)
            stalled.send_signal(signal.SIGSTOP)
            await asyncio.sleep(2)
            stalled.send_signal(signal.SIGCONT)
            await asyncio.sleep(0.5)
            stalled.send_signal(signal.SIGSTOP)
        await asyncio.sleep(0.5)  # killed
    gateway.report.check()


LCM_RECEIVER: Final = """
import sys
from gateway.outputs.lcm.connection import open_lcm
receiver = open_lcm(sys.argv[1])
receiver.subscribe(".*", lambda channel, message: None)
print("done", flush=True)
while True:
    receiver.handle()
"""


async def test_routers_and_lcm_receivers_that_stop(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"dense": dense_server}) as gateway:
        for _ in range(2):  # restarted once
            async with (
                zenoh_peer("routers", gateway.zenoh_endpoint, 1) as router,
                python("-c", LCM_RECEIVER, f"{gateway.lcm_url}&recv_buf_size=4096") as receiver,
            ):
                await asyncio.gather(printed(router), printed(receiver))
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
            await asyncio.gather(printed(first), printed(second))
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
        await printed(peer)
        await asyncio.sleep(4)
    gateway.report.check()


async def test_peers_that_flood(gateway_under_attack: GatewayUnderAttack) -> None:
    floods = {"connections": 300, "keys": 10_000, "tokens": 5_000, "puts": 100_000}
    async with gateway_under_attack() as gateway, contextlib.AsyncExitStack() as stack:
        peers = [
            await stack.enter_async_context(zenoh_peer(kind, gateway.zenoh_endpoint, count))
            for kind, count in floods.items()
        ]
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*map(printed, peers)), 5)
    gateway.report.check()


ROS_ROUTER: Final = """
import sys, zenoh

with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    is_first = True

    def on_sample(sample):
        global is_first
        if is_first:
            is_first = False
            print("received", flush=True)

    session.declare_subscriber("0/**", on_sample)
    sys.stdin.read()
"""
"""A router with a node that subscribes to everything."""


def ros(endpoint: str) -> dict[str, Any]:
    return {"ros2": {"enabled": True, "connect": endpoint}}


async def test_ros_routers_that_go_come_back_and_do_not_read_at_the_end(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    endpoint = free_endpoint()
    router = ("-c", ROS_ROUTER, json.dumps(zenoh_keys("router", listen=endpoint)))
    async with contextlib.AsyncExitStack() as stack:
        async with gateway_under_attack({"dense": dense_server}, ros(endpoint)) as gateway:
            async with python(*router) as first:
                await printed(first)
                first.send_signal(signal.SIGSTOP)
                await asyncio.sleep(1.5)
                first.send_signal(signal.SIGCONT)
                await asyncio.sleep(0.3)
            second = await stack.enter_async_context(python(*router))
            await printed(second)
            second.send_signal(signal.SIGSTOP)
            await asyncio.sleep(1.5)
        gateway.report.check()


async def test_no_ros_router_but_other_programs(gateway_under_attack: GatewayUnderAttack) -> None:
    """Nonsense in place of a handshake, and a program that says nothing."""
    answers = [b"HTTP/1.1 400 Bad Request\r\n\r\n" * 1000, bytes(100_000), b""]

    async def answer_all(client: Client) -> None:
        if len(answers) > 1:
            client.send(answers.pop(0))
            await asyncio.sleep(0.5)
        else:
            answers.clear()
            await asyncio.sleep(60)

    async with (
        ScriptedServer(answer_all) as server,
        gateway_under_attack({}, ros(f"tcp/127.0.0.1:{server.port}")) as gateway,
    ):
        await wait_until_async(lambda: not answers)
        await asyncio.sleep(1)
    gateway.report.check()
