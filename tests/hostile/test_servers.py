"""Hostile servers of many kinds, several at once: the healthy source loses nothing."""

import asyncio
import signal
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from tests.hostile.gateway_under_attack import (
    GatewayUnderAttack,
    RunningGateway,
    log_lines_per_minute,
    printed,
    python,
)
from tests.hostile.server_floods import BREAKING, FLOODS, Group
from tests.hostile.servers import SERVERS
from tests.support.gateway_process import simulator
from tests.support.networks import free_port
from tests.support.servers import ScriptedServer
from tests.support.waiting import wait_until_async

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


# A source that alone is more than the gateway can do -------------------------------------------

SUBSCRIBER: Final = """
import json, sys, zenoh

from tests.support.networks import zenoh_keys

with zenoh.open(zenoh.Config.from_json5(json.dumps(zenoh_keys("client", connect=sys.argv[1])))) as session:
    session.declare_subscriber("mocap/**", lambda sample: None)
    print("done", flush=True)
    sys.stdin.read()
"""
"""Subscribes to everything, also as JSON."""

TOOLS: Final = ("--tools", "256", "--rate", "200", "--analog-rate", "200")
LARGE: Final = (*TOOLS, "--markers", "3000", "--analog", "500")


@pytest.mark.parametrize(
    ("scene", "outputs"),
    [
        pytest.param(TOOLS, {}, id="many tools"),
        pytest.param(
            LARGE, {"vrpn": free_port, "foxglove": free_port, "lsl": None}, id="large frames, every output"
        ),
    ],
)
async def test_a_source_that_is_too_much(
    gateway_under_attack: GatewayUnderAttack, tmp_path: Path, scene: tuple[str, ...], outputs: dict[str, Any]
) -> None:
    settings: dict[str, Any] = {
        name: {"enabled": True, "tool_poses": True} for name in ("zenoh", "lcm", "takes")
    }
    settings["takes"] |= {"directory": str(tmp_path / "takes"), "keep_last_s": 60}
    for name, port in outputs.items():
        settings[name] = {"enabled": True} | ({"port": port()} if port else {})
    with simulator(*scene) as (server, _):
        async with (
            gateway_under_attack({"crowd": server}, settings) as gateway,
            python("-c", SUBSCRIBER, gateway.zenoh_endpoint) as subscriber,
        ):
            await printed(subscriber)
            await asyncio.sleep(4)
    gateway.report.check()


# The instruments themselves --------------------------------------------------------------------

STOP_S: Final = 0.5


async def test_without_an_attack_nothing_is_missing(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        await asyncio.sleep(1)
    report = gateway.report
    report.check()
    assert report.num_received > 0
    assert report.rss_before_kib > 0
    assert report.rss_after_kib > 0


async def test_a_standstill_of_the_gateway_is_noticed(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        await gateway.stop_for(STOP_S)
        await asyncio.sleep(0.5)
        await gateway.arrivals()
    assert set(gateway.report.longest_silence_s) == {"zenoh", "lcm"}
    assert min(gateway.report.longest_silence_s.values()) >= STOP_S / 2  # a busy recorder was late before
    assert gateway.report.num_missing == 0


async def test_the_end_of_the_gateway_is_noticed(gateway_under_attack: GatewayUnderAttack) -> None:
    async with gateway_under_attack() as gateway:
        gateway.process.send_signal(signal.SIGABRT)
        await gateway.process.wait()
    assert gateway.report.exit_status == -signal.SIGABRT
    assert any("during the attack" in problem for problem in gateway.report.problems())


def test_lines_of_the_log_are_counted_in_the_worst_minute_and_by_source() -> None:
    quiet = [f"2026-01-02 03:{minute:02}:30,000 INFO stopping" for minute in range(10, 20)]
    burst = [f"2026-01-02 03:20:{second:02},500 ERROR one: defect\nTraceback" for second in range(30)]
    other = [f"2026-01-02 03:20:{second:02},600 INFO two (3d): connected" for second in range(50)]
    assert log_lines_per_minute("\n".join(quiet), ()) == 2  # 60 s apart
    assert log_lines_per_minute("\n".join([*quiet, *burst, *other]), ("one", "two")) == 60
    assert log_lines_per_minute("\n".join([*quiet, *burst, *other]), ()) == 110
