"""Hostile VRPN clients: neither the frames of the healthy source nor other VRPN clients suffer from them."""

import asyncio

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.port_attacks import ATTACK_S, attacking, check
from tests.hostile.vrpn_clients import ATTACKS
from tests.networks import free_port
from tests.vrpn_client import VrpnClient
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

MAX_GROWTH_KIB = 30 * 1024
"""How much memory an attack may leave behind."""


@pytest.mark.parametrize("name", ATTACKS)
async def test_attack_on_the_port(name: str, gateway_under_attack: GatewayUnderAttack) -> None:
    port = free_port()
    vrpn = {"enabled": True, "port": port}
    async with (
        gateway_under_attack(settings={"vrpn": vrpn}) as gateway,
        await VrpnClient.connect(port) as client,
    ):
        await wait_until_async(lambda: client.poses)
        async with attacking(ATTACKS[name], port):
            await asyncio.sleep(ATTACK_S)
            num_poses = len(client.poses)
            await wait_until_async(lambda: len(client.poses) > num_poses + 100)
            # A client that comes during the attack is served, too, if need be after some attempts.
            async with await _connected(port) as late:
                await wait_until_async(lambda: late.poses)
            assert not client.has_ended
    check(gateway.report, MAX_GROWTH_KIB)


async def _connected(port: int) -> VrpnClient:
    """Return a client that has been accepted; libvrpn, too, tries again until it is."""
    while True:
        client = await VrpnClient.connect(port)
        await wait_until_async(lambda client=client: client.trackers or client.has_ended)  # type: ignore[misc]
        if client.trackers:
            return client
        await client.close()
