"""Routers of ROS that stop, speak another protocol or come and go: nobody else notices."""

import asyncio
import json
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import pytest

from tests.gateway_process import simulator
from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.networks import free_endpoint, zenoh_keys
from tests.servers import Client, ScriptedServer
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

ROUTER = """
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


@pytest.fixture(scope="module")
def dense_server() -> Iterator[int]:
    """The port of a server that fills the buffers of a router that does not read."""
    with simulator("--markers", "1000", "--tools", "100", "--rate", "200", "--analog-rate", "200") as (
        port,
        _,
    ):
        yield port


@asynccontextmanager
async def router(endpoint: str) -> AsyncIterator[Process]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", ROUTER, json.dumps(zenoh_keys("router", listen=endpoint))),
        stdin=PIPE,
        stdout=PIPE,
    )
    try:
        yield process
    finally:
        process.kill()
        await process.wait()


async def received(process: Process) -> None:
    assert process.stdout is not None
    assert await process.stdout.readline() == b"received\n"


async def test_routers_that_stop_go_and_come_back(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    endpoint = free_endpoint()
    settings = {"ros2": {"enabled": True, "connect": endpoint}}
    async with gateway_under_attack({"dense": dense_server}, settings) as gateway:
        async with router(endpoint) as first:
            await received(first)
            first.send_signal(signal.SIGSTOP)
            await asyncio.sleep(1.5)
            first.send_signal(signal.SIGCONT)
            await asyncio.sleep(0.3)
        async with router(endpoint) as second:
            await received(second)
    gateway.report.check()


async def test_the_gateway_stops_while_the_router_does_not_read(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    endpoint = free_endpoint()
    settings = {"ros2": {"enabled": True, "connect": endpoint}}
    async with router(endpoint) as stopped:
        async with gateway_under_attack({"dense": dense_server}, settings) as gateway:
            await received(stopped)
            stopped.send_signal(signal.SIGSTOP)
            await asyncio.sleep(1.5)
        gateway.report.check()


async def test_no_router_but_other_programs(gateway_under_attack: GatewayUnderAttack) -> None:
    """Nonsense in place of a handshake, and a program that says nothing."""
    answers = [b"HTTP/1.1 400 Bad Request\r\n\r\n" * 1000, bytes(100_000), b""]

    async def answer_all(client: Client) -> None:
        if len(answers) > 1:
            client.send(answers.pop(0))
            await asyncio.sleep(0.5)
        else:
            answers.clear()
            await asyncio.sleep(60)

    async with ScriptedServer(answer_all) as server:
        settings = {"ros2": {"enabled": True, "connect": f"tcp/127.0.0.1:{server.port}"}}
        async with gateway_under_attack({}, settings) as gateway:
            await wait_until_async(lambda: not answers)
            await asyncio.sleep(1)
    gateway.report.check()
