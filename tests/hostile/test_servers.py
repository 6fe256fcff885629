"""Hostile servers of many kinds, several at once: the healthy source loses nothing."""

import asyncio
from contextlib import AsyncExitStack
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.servers import SERVERS
from tests.servers import ScriptedServer

pytestmark = pytest.mark.netns

ATTACK_S: Final = 2.5


@pytest.mark.parametrize("group", SERVERS)
async def test_hostile_servers_harm_nobody(group: str, gateway_under_attack: GatewayUnderAttack) -> None:
    async with AsyncExitStack() as stack:
        attackers = {
            name: (await stack.enter_async_context(ScriptedServer(script))).port
            for name, script in SERVERS[group].items()
        }
        async with gateway_under_attack(attackers) as gateway:
            await asyncio.sleep(ATTACK_S)
    gateway.report.check()
