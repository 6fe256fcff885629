"""Peers that ask without end, on Zenoh and on LCM: the frames of the healthy source do not wait for them."""

import asyncio
import itertools
import json
import signal
import socket
import struct
from asyncio.subprocess import DEVNULL, Process
from contextlib import AbstractAsyncContextManager, AsyncExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import rtc3d

from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway, printed, python
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

MAX_GROWTH_MIB = 40
"""How much memory an attack may leave behind; without limits, it was 160 to 300 MB."""


def asker(
    gateway: RunningGateway, count: int, *selectors: str, num_bytes: int = 0
) -> AbstractAsyncContextManager[Process]:
    """Run ``ask`` of tests/hostile/zenoh_peer.py until the end of the block."""
    facts = (gateway.zenoh_endpoint, str(count), str(num_bytes))
    return python("-m", "tests.hostile.zenoh_peer", "ask", *facts, *selectors, stderr=DEVNULL)  # Zenoh's log


async def ask(gateway: RunningGateway, count: int, *selectors: str, num_bytes: int = 0) -> dict[str, int]:
    """Ask ``count`` times at once; return the number of replies by code."""
    async with asker(gateway, count, *selectors, num_bytes=num_bytes) as process:
        output, _ = await process.communicate()
    return dict(json.loads(output.splitlines()[-1]))


async def wait_for_frames(gateway: RunningGateway) -> None:
    """Wait until the attacked source has frames."""
    await wait_until_async(lambda: "lab" in gateway.log and "streaming" in gateway.log.partition(" lab ")[2])


async def test_many_questions(dense_server: int, gateway_under_attack: GatewayUnderAttack) -> None:
    """Floods of questions are refused beyond a rate, and a calm asker is answered after them."""
    selectors = (
        *("mocap/lab/**?format=json;x{}=1", "mocap/**?fresh=true", "mocap/lab/{}", "mocap/*/3d?format=json"),
        *("mocap/lab/parameters/*?format=json;fresh=true", "mocap/l$*b/s$*/**", "**?_a={}", "mocap/lab/*?{}"),
        *("mocap/**" + "/lab/**" * 40, "mocap/lab/schema/" + "$*a" * 20 + "$*b", "mocap/lab/x{}/**"),
        *("mocap/lab/recording?set=start", "mocap/lab/" + 9999 * "x", "mocap/lab/3d?" + 9999 * "y"),
    )
    async with gateway_under_attack({"lab": dense_server}) as gateway:
        await wait_for_frames(gateway)
        large = await ask(gateway, 200, "mocap/healthy/status", num_bytes=1_000_000)
        assert set(large) == {"bad-request", "unanswered"}
        frames = await ask(gateway, 2000, "mocap/lab/3d?format=json")
        assert frames["ok"] > 0
        assert set(frames) == {"ok", "rate", "unanswered"}
        await still_answers(gateway, "mocap/lab/status")
        everything = await ask(gateway, 8000, "mocap/lab/**")
        assert everything["ok"] > 0
        assert everything["rate"] > 0
        await asyncio.gather(*(ask(gateway, 3000, *selectors) for _ in range(2)))
        await still_answers(gateway, "mocap/lab/status")
    gateway.report.check(MAX_GROWTH_MIB)


async def still_answers(gateway: RunningGateway, selector: str) -> None:
    """Check that a peer that asks calmly gets an answer, at the latest when the flood is answered."""
    for _ in range(60):
        if (await ask(gateway, 1, selector)).get("ok"):
            return
        await asyncio.sleep(0.5)
    raise AssertionError(f"the gateway does not answer {selector} any more")


async def test_askers_that_do_not_read_the_answers(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"lab": dense_server}) as gateway:
        await wait_for_frames(gateway)
        spool = Path(gateway.folder) / "spool"
        spool.mkdir(exist_ok=True)
        # The answer on its way to the stalled asker, a whole file, stays in memory.
        (spool / "lab-20260102T030405.678901Z.c3d").write_bytes(bytes(10_000_000))
        async with asker(
            gateway, 1000, "mocap/lab/3d?format=json", "mocap/lab/c3d", "mocap/lab/**"
        ) as stalled:
            await printed(stalled)
            stalled.send_signal(signal.SIGSTOP)
            await asyncio.sleep(6)
            # Answers to others wait for the stalled one, frames do not.
    gateway.report.check(MAX_GROWTH_MIB)


async def stop_after_its_questions(process: Process) -> None:
    await printed(process)
    process.send_signal(signal.SIGSTOP)


async def test_askers_for_the_whole_history_that_do_not_read_the_answers(
    dense_server: int, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with gateway_under_attack({"lab": dense_server}) as gateway, AsyncExitStack() as askers:
        await wait_for_frames(gateway)
        selectors = ("mocap/lab/3d?from=0", "mocap/lab/analog?last_s=60;_x={}", "mocap/*/*?since_utime=0")
        stalled = [await askers.enter_async_context(asker(gateway, 600, *selectors)) for _ in range(10)]
        await asyncio.gather(*map(stop_after_its_questions, stalled))
        await asyncio.sleep(6)  # longer than Zenoh waits for a peer that does not read
        await still_answers(gateway, "mocap/healthy/3d?last_s=1")
    gateway.report.check(MAX_GROWTH_MIB)


async def test_floods_on_lcm(dense_server: int, gateway_under_attack: GatewayUnderAttack) -> None:
    """Requests, old and fresh, malformed ones, and large ones that come in fragments."""
    request = rtc3d.parameters_request_t()
    request.requester = "flood"
    messages = [request.encode(), bytes(40), bytes(60_000), bytes(200_000)]
    request.fresh = True
    messages.append(request.encode())
    async with gateway_under_attack({"lab": dense_server}) as gateway:
        await wait_for_frames(gateway)
        connection = open_lcm(lcm_queries_url(gateway.lcm_url))
        for message in messages:
            for _ in range(100):  # 1 s
                for _ in range(100 if len(message) < 1000 else 5):
                    connection.publish("MOCAP_LAB_PARAMETERS_REQUEST", message)
                await asyncio.sleep(0.01)
    gateway.report.check(MAX_GROWTH_MIB)


async def test_damaged_datagrams_of_lcm(gateway_under_attack: GatewayUnderAttack) -> None:
    """LCM's own library takes the rest of a channel from the datagram before, and crashes."""
    request = struct.pack(">II", 0x4C433032, 0) + b"MOCAP_HEALTHY_PARAMETERS_REQUEST\0" + bytes(40)
    numbers = (0, 1, 40, 4000, 1 << 31, (1 << 32) - 1)
    fragments = [
        struct.pack(">IIIIHH", 0x4C433033, 0, size, offset, number, 2) + request[8:]
        for size, offset, number in itertools.product(numbers, numbers, (0, 1, 2, 0xFFFF))
    ]
    beginnings = [request[:length] for length in range(len(request))]
    async with gateway_under_attack() as gateway:
        url = urlsplit(lcm_queries_url(gateway.lcm_url))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect((str(url.hostname), url.port or 0))
            for beginning in beginnings:
                sender.send(request.replace(b"MOCAP", b"OTHER"))
                sender.send(beginning)
                await asyncio.sleep(0.01)
            for fragment in fragments:
                sender.send(fragment)
                await asyncio.sleep(0.01)
    gateway.report.check(MAX_GROWTH_MIB)
