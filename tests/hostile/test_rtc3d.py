"""Hostile RTC3D clients: neither the frames of the healthy source nor other clients suffer from them."""

import asyncio
import contextlib

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.port_attacks import ATTACK_S, attacking, check
from tests.hostile.rtc3d_clients import ATTACKS
from tests.integration.raw_client import connected, consecutive
from tests.networks import free_port
from tests.unit.rtc3d_server.wire import COMMAND

pytestmark = pytest.mark.netns

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
        frames = await client.frames(10)
        async with attacking(ATTACKS[name], port):
            end_s = asyncio.get_running_loop().time() + ATTACK_S
            while asyncio.get_running_loop().time() < end_s:
                frames += await client.frames(10)
            # A client that comes during the attack is served, too, if need be after some attempts.
            await asyncio.wait_for(_served(port), 20)
        assert consecutive(frames)
    check(gateway.report, MAX_GROWTH_KIB)


async def _served(port: int) -> None:
    """Return when a new client has been served."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            async with connected(Port(port)) as client:
                if (await client.ask("SendCurrentFrame 3D"))[0] == COMMAND:
                    await client.frames(1)
                    return
        await asyncio.sleep(0.01)
