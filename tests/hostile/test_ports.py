"""Attacks on the ports of outputs: neither the healthy source nor other clients of the port suffer from them.

One gateway for each output endures all attacks in turn.
"""

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack, num_missing, python, rss_kib
from tests.hostile.port_attacks import ATTACKS, Attack, attacking
from tests.integration.raw_client import connected, consecutive
from tests.support.foxglove_viewer import viewing
from tests.support.lsl_receiver import LslReceiver, lsl_config
from tests.support.networks import free_port
from tests.support.vrpn_client import VrpnClient
from tests.support.waiting import wait_until_async
from tests.unit.session.server.wire import COMMAND

pytestmark = [pytest.mark.netns, pytest.mark.timeout(300)]

ATTACK_S: Final = 1.0
LATE_CLIENT_TIMEOUT_S: Final = 60.0
MAX_LSL_KIB: Final = 900 * 1024


class Target(NamedTuple):
    """An output with a port.

    The block of its ``client`` begins when the client is served, and its end fails if it is served no longer.
    """

    settings: Callable[[int, Path], Mapping[str, Any]]
    client: Callable[[int, Path], AbstractAsyncContextManager[None]]
    attacks: Mapping[str, Attack]
    max_growth_mib: int
    """How much memory all attacks together may leave behind."""
    serves_during_attacks: bool = True
    """Whether new clients are served during an attack, not only after it."""


@dataclass
class Port:
    port: int


@contextlib.asynccontextmanager
async def rtc3d_client(port: int, _: Path) -> AsyncIterator[None]:
    """A client that gets every frame."""
    async with connected(Port(port)) as client:
        if (await client.ask("StreamFrames 3D"))[0] != COMMAND:
            raise ConnectionRefusedError
        frames = await client.frames(10)
        reading = asyncio.create_task(_keep_reading(client, frames))
        try:
            yield
            before = len(frames)
            await wait_until_async(lambda: reading.done() or len(frames) > before + 20)
            assert not reading.done(), "the client was disconnected"
        finally:
            reading.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await reading
        assert consecutive(frames)


async def _keep_reading(client: Any, frames: list[Any]) -> None:
    while True:
        frames += await client.frames(1)


@contextlib.asynccontextmanager
async def vrpn_client(port: int, _: Path) -> AsyncIterator[None]:
    """A client of all trackers."""
    async with await VrpnClient.connect(port) as client:
        await wait_until_async(lambda: client.trackers or client.has_ended)
        if client.has_ended:
            raise ConnectionRefusedError
        await wait_until_async(lambda: client.poses)
        yield
        before = len(client.poses)
        await wait_until_async(lambda: client.has_ended or len(client.poses) > before + 20)
        assert not client.has_ended


@contextlib.asynccontextmanager
async def foxglove_client(port: int, _: Path) -> AsyncIterator[None]:
    """A viewer that gets frames; its own process may be too slow for some."""
    async with viewing(port, "/healthy/markers") as viewer:
        received = await viewer.wait_for("/healthy/markers", 10)
        yield
        await viewer.wait_for("/healthy/markers", len(received) + 20)


@contextlib.asynccontextmanager
async def lsl_client(_port: int, folder: Path) -> AsyncIterator[None]:
    """A receiver that finds the stream; it may lose the connection while liblsl starts again."""
    receiver = LslReceiver(folder / "lsl_api.cfg", "healthy_3d")
    try:
        await wait_until_async(lambda: receiver.samples["healthy_3d"], LATE_CLIENT_TIMEOUT_S)
        yield
    finally:
        receiver.close()


def viewers(name: str) -> Attack:
    """Viewers in a process of their own, which would otherwise take the time of this one."""

    async def attack(port: int) -> None:
        async with python("-m", "tests.hostile.port_attacks", name, str(port)) as process:
            await process.wait()

    return attack


TARGETS: Final = {
    "rtc3d": Target(
        lambda port, _: {"enabled": True, "ports": {"healthy": port}}, rtc3d_client, ATTACKS["rtc3d"], 60
    ),
    "vrpn": Target(lambda port, _: {"enabled": True, "port": port}, vrpn_client, ATTACKS["vrpn"], 60),
    "foxglove": Target(
        lambda port, _: {"enabled": True, "port": port},
        foxglove_client,
        {name: viewers(name) for name in ATTACKS["foxglove"]},
        100,
        serves_during_attacks=False,
    ),
    "lsl": Target(
        lambda _, folder: {"enabled": True, "config": str(lsl_config(folder))},
        lsl_client,
        ATTACKS["lsl"],
        100,
        serves_during_attacks=False,
    ),
}


async def served(target: Target, port: int, folder: Path) -> None:
    """Return when a new client is served, if need be after some attempts."""
    async with asyncio.timeout(LATE_CLIENT_TIMEOUT_S):
        while True:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):
                async with target.client(port, folder):
                    return
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("output", TARGETS)
async def test_attacks_on_a_port_disturb_no_other_client(
    output: str, gateway_under_attack: GatewayUnderAttack, tmp_path: Path
) -> None:
    """A client from before keeps its frames, a new one is served, and memory stays bounded."""
    target, port = TARGETS[output], free_port()
    settings = {output: target.settings(port, tmp_path)}
    async with gateway_under_attack(settings=settings) as gateway:
        for name, attack in target.attacks.items():
            async with target.client(port, tmp_path), attacking(attack, port):
                await asyncio.sleep(ATTACK_S)
                if target.serves_during_attacks:
                    await served(target, port, tmp_path)
                assert children_kib(gateway.process.pid) < MAX_LSL_KIB, name
            await served(target, port, tmp_path)
            assert num_missing(await gateway.arrivals()) == 0, name
    gateway.report.check(target.max_growth_mib)
    assert not re.search("Traceback|ERROR", gateway.report.log)


def children_kib(process_id: int) -> int:
    """Return the memory of the gateway's own processes: that of LSL, if it runs at the moment."""
    children = Path(f"/proc/{process_id}/task/{process_id}/children").read_text().split()
    return sum(map(rss_kib, map(int, children)))
