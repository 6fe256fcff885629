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
from typing import Any, Final

from gateway.outputs.contract import Publisher
from gateway.outputs.zenoh.output import ZenohOutput
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.contract.rigs import MARKERS
from tests.support.networks import free_endpoint, zenoh_keys
from tests.support.waiting import wait_until_async

MESSAGE = bytes(1200)
NUM_IN_BURST = 400
"""These have 0.5 MB: less than Zenoh queues for a subscriber, and several times as much as SMALL_BUFFERS."""

SMALL_BUFFERS: Final = {"tcp": {"so_sndbuf": 16_384, "so_rcvbuf": 16_384}}
NUM_PACED = 10_000

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
async def subscriber(endpoint: str, link: dict[str, Any]) -> AsyncIterator[Process]:
    """Run a subscriber that prints how many messages it has received when it receives LAST."""
    keys = zenoh_keys("client", connect=endpoint)
    keys["transport"]["link"] = link
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", SUBSCRIBER, json.dumps(keys)), stdin=PIPE, stdout=PIPE
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


@asynccontextmanager
async def open_output(link: dict[str, Any]) -> AsyncIterator[tuple[ZenohOutput, str]]:
    endpoint = free_endpoint()
    keys = zenoh_keys("peer", listen=endpoint)
    keys["transport"]["link"] = link
    output = ZenohOutput(ZenohSettings(config=keys))
    output.start()
    try:
        await wait_until_async(lambda: output.health().connected)
        yield output, endpoint
    finally:
        output.close()


async def count_until_last(process: Process, publisher: Publisher) -> int:
    """Publish LAST until one is received; return how many other messages were received before."""
    count = asyncio.create_task(line(process))
    while not count.done():
        publisher.publish(LAST)
        await asyncio.wait([count], timeout=0.1)
    return int(await count) - 1


async def test_a_burst_waits_for_a_subscriber_that_is_late() -> None:
    """With Zenoh's own queue of 2 batches, most of this burst is dropped."""
    async with open_output(SMALL_BUFFERS) as (output, endpoint), subscriber(endpoint, SMALL_BUFFERS) as late:
        publisher = output.publisher(MARKERS)
        await wait_until_async(lambda: publisher.wanted)
        late.send_signal(signal.SIGSTOP)
        for _ in range(NUM_IN_BURST):
            publisher.publish(MESSAGE)
        late.send_signal(signal.SIGCONT)
        assert await count_until_last(late, publisher) == NUM_IN_BURST


async def test_a_stalled_subscriber_does_not_hold_up_another() -> None:
    async with (
        open_output({}) as (output, endpoint),
        subscriber(endpoint, {}) as healthy,
        subscriber(endpoint, {}) as stalled,
    ):
        publisher = output.publisher(MARKERS)
        await wait_until_async(lambda: publisher.wanted)
        stalled.send_signal(signal.SIGSTOP)
        for number in range(NUM_PACED):
            publisher.publish(MESSAGE)
            if number % 5 == 4:
                await asyncio.sleep(0.001)  # up to 5000 messages per second
        assert await count_until_last(healthy, publisher) == NUM_PACED
