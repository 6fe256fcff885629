"""Zenoh's back-pressure: a put waits for a slow subscriber, but not long for one that stalls.

The subscribers are processes of their own, because all Zenoh sessions of one process share their threads.
"""

import asyncio
import json
import signal
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.contract.rigs import MARKERS
from tests.networks import free_endpoint, zenoh_keys
from tests.waiting import wait_until_async

MESSAGE = bytes(1200)
NUM_MESSAGES = 40_000
"""At once, this is ten times as much as TCP buffers."""

LAST = b"last"

SUBSCRIBER = """
import json, sys, zenoh
received = 0
def receive(sample):
    global received
    received += 1
    if sample.payload.to_bytes() == b"last":
        print(received, flush=True)
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
subscriber = session.declare_subscriber("mocap/**", receive)
print("ready", flush=True)
sys.stdin.read()
session.close()
"""


@asynccontextmanager
async def subscriber(endpoint: str) -> AsyncIterator[Process]:
    """Run a subscriber that prints how many messages it has received when it receives LAST."""
    keys = json.dumps(zenoh_keys("client", connect=endpoint))
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", SUBSCRIBER, keys), stdin=PIPE, stdout=PIPE
    )
    try:
        assert await line(process) == "ready"
        yield process
    finally:
        process.kill()
        await process.wait()


async def line(process: Process) -> str:
    assert process.stdout is not None
    return (await process.stdout.readline()).decode().strip()


@pytest.fixture
async def output_and_endpoint() -> AsyncIterator[tuple[ZenohOutput, str]]:
    endpoint = free_endpoint()
    output = ZenohOutput(ZenohSettings(config=zenoh_keys("peer", listen=endpoint)))
    output.start()
    await wait_until_async(lambda: output.health().connected)
    yield output, endpoint
    output.close()


async def test_a_subscriber_that_reads_receives_a_burst(
    output_and_endpoint: tuple[ZenohOutput, str],
) -> None:
    """With Zenoh's own 1 ms, 30 to 50 % of this burst are dropped."""
    output, endpoint = output_and_endpoint
    publisher = output.publisher(MARKERS)
    async with subscriber(endpoint) as healthy:
        await wait_until_async(lambda: publisher.wanted)
        for _ in range(NUM_MESSAGES):
            publisher.publish(MESSAGE)
        await asyncio.sleep(0.2)  # for Zenoh's queue, so that the last message is not dropped
        publisher.publish(LAST)
        assert int(await line(healthy)) > 0.9 * NUM_MESSAGES


async def test_a_stalled_subscriber_does_not_hold_up_another(
    output_and_endpoint: tuple[ZenohOutput, str],
) -> None:
    output, endpoint = output_and_endpoint
    publisher = output.publisher(MARKERS)
    async with subscriber(endpoint) as healthy, subscriber(endpoint) as stalled:
        await wait_until_async(lambda: publisher.wanted)
        stalled.send_signal(signal.SIGSTOP)
        for number in range(NUM_MESSAGES // 4):
            publisher.publish(MESSAGE)
            if number % 5 == 4:
                await asyncio.sleep(0.001)  # up to 5000 messages per second
        publisher.publish(LAST)
        assert int(await line(healthy)) == NUM_MESSAGES // 4 + 1
