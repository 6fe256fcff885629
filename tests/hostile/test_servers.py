"""Hostile servers of many kinds, several at once: the healthy source loses nothing."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any, Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.hostile.server_floods import BREAKING, FLOODS, Group
from tests.hostile.servers import SERVERS
from tests.servers import ScriptedServer
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

ATTACK_S: Final = 2.5
BREAKING_S: Final = 5.0
GROUPS: Final = {name: Group(scripts, {}) for name, scripts in SERVERS.items()} | FLOODS


@asynccontextmanager
async def attacked(
    run: GatewayUnderAttack, group: Group
) -> AsyncIterator[tuple[RunningGateway, dict[str, ScriptedServer]]]:
    """Run a gateway with these servers."""
    async with AsyncExitStack() as stack:
        servers = {
            name: await stack.enter_async_context(ScriptedServer(script))
            for name, script in group.servers.items()
        }
        attackers = {name: {"port": server.port, **group.settings} for name, server in servers.items()}
        yield await stack.enter_async_context(run(attackers)), servers


@pytest.mark.parametrize("group", GROUPS)
async def test_hostile_servers_harm_nobody(group: str, gateway_under_attack: GatewayUnderAttack) -> None:
    """No server takes time or frames from others, or writes what it likes into the log."""
    async with attacked(gateway_under_attack, GROUPS[group]) as (gateway, servers):
        await asyncio.sleep(ATTACK_S)
        await wait_until_async(lambda: all(server.connections for server in servers.values()))
        if "tiny-frames" in servers:  # it does not wait for the others, either
            await wait_for_frames(gateway, "tiny-frames", 10_000)
    gateway.report.check()
    lines = gateway.log.splitlines()
    assert all(line.isprintable() for line in lines)
    assert max(map(len, lines)) < 3000


async def wait_for_frames(gateway: RunningGateway, source: str, count: int) -> None:
    """Wait until ``count`` frames of a source were received."""
    async with asyncio.timeout(120):
        while (await num_frames(gateway.metrics_port)).get(source, 0) < count:  # noqa: ASYNC110 - asks it
            await asyncio.sleep(0.1)


async def num_frames(port: int) -> Mapping[str, float]:
    """Return the number of frames received by source."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    page = (await reader.read()).decode()
    writer.close()
    lines = [line for line in page.splitlines() if line.startswith("rtc3d_gateway_frames_received_total{")]
    return {line.partition('source="')[2].partition('"')[0]: float(line.split()[-1]) for line in lines}


async def test_servers_that_break_again_and_again(gateway_under_attack: GatewayUnderAttack) -> None:
    """Attempts become rare, so that such a server costs little and fills no log."""
    slow: dict[str, Any] = {"reconnect": {"first_delay_s": 0.1, "max_delay_s": 5.0}}
    async with attacked(gateway_under_attack, Group(BREAKING, slow)) as (gateway, servers):
        await asyncio.sleep(BREAKING_S)
        # 0.1 + 0.2 + 0.4 + 0.8 + 1.6 + 3.2 s, each shortened by up to half; without it, there are 50.
        assert {name for name, server in servers.items() if server.connections > 12} == set()
    gateway.report.check()
    lines = [line.split() for line in gateway.report.log.splitlines()]
    for name in BREAKING:
        assert sum(any(word.startswith(name) for word in line[:5]) for line in lines) <= 10
