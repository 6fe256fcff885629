"""Hostile RTC3D clients: neither the frames of the healthy source nor other clients suffer from them."""

import asyncio
import contextlib

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.rtc3d_clients import ATTACKS
from tests.integration.raw_client import connected
from tests.networks import free_port
from tests.unit.rtc3d_server.wire import COMMAND

pytestmark = pytest.mark.netns

ATTACK_S = 1.5
MAX_GROWTH_KIB = 60 * 1024
"""How much memory an attack may leave behind."""


class Port:
    def __init__(self, port: int) -> None:
        self.port = port


@pytest.mark.parametrize("name", ATTACKS)
async def test_attack_on_the_port(name: str, gateway_under_attack: GatewayUnderAttack) -> None:
    port = free_port()
    rtc3d = {"enabled": True, "ports": {"healthy": port}}
    async with (
        gateway_under_attack(settings={"rtc3d": rtc3d}) as gateway,
        connected(Port(port)) as client,
    ):
        await client.ask("StreamFrames 3D")
        numbers = [frame[0].frame_number for frame in await client.frames(10)]
        attack = asyncio.create_task(_run(name, port))
        end_s = asyncio.get_running_loop().time() + ATTACK_S
        while asyncio.get_running_loop().time() < end_s:
            numbers += [frame[0].frame_number for frame in await client.frames(10)]
        # A client that comes during the attack is served, too, if need be after some attempts.
        await asyncio.wait_for(_served(port), 20)
        attack.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await attack
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    report = gateway.report
    report.check()
    assert report.rss_after_kib - report.rss_before_kib < MAX_GROWTH_KIB, report


async def _run(name: str, port: int) -> None:
    while True:
        with contextlib.suppress(OSError):
            await ATTACKS[name](port)
        await asyncio.sleep(0.01)


async def _served(port: int) -> None:
    """Return when a new client has been served."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            async with connected(Port(port)) as client:
                if (await client.ask("SendCurrentFrame 3D"))[0] == COMMAND:
                    await client.frames(1)
                    return
        await asyncio.sleep(0.01)
