"""Hostile viewers on the port of the output ``foxglove``: other sources and other viewers do not notice."""

import asyncio
import re
import sys

import pytest

from tests.foxglove_viewer import viewing
from tests.hostile.foxglove_viewers import ATTACKS
from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.networks import free_port

pytestmark = pytest.mark.netns

ATTACK_S = 1.5
MAX_GROWTH_KIB = 100 * 1024


@pytest.mark.parametrize("attack", ATTACKS)
async def test_hostile_viewers(attack: str, gateway_under_attack: GatewayUnderAttack) -> None:
    port = free_port()
    settings = {"foxglove": {"enabled": True, "port": port}}
    async with gateway_under_attack(settings=settings) as gateway:
        async with viewing(port, "/healthy/markers") as viewer:
            received = await viewer.wait_for("/healthy/markers", 10)
            attacker = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "tests.hostile.foxglove_viewers", attack, str(port))
            )
            await asyncio.sleep(ATTACK_S)
            assert attacker.returncode is None
            before = len(received)
            await viewer.wait_for("/healthy/markers", before + 100)
            attacker.kill()
            await attacker.wait()
            assert_nothing_lost([log.time_ns for log in received])
        await serves_again(port)
    report = gateway.report
    report.check()
    assert report.rss_after_kib - report.rss_before_kib < MAX_GROWTH_KIB
    others = [line for line in report.log.splitlines() if re.search("Traceback|ERROR", line)]
    assert not others, "\n".join(others)


def assert_nothing_lost(times_ns: list[int]) -> None:
    """A viewer that reads got each frame of the healthy source, at 200 Hz.

    The times of capture follow the server's clock by some ms while the computer is busy.
    """
    num_frames = (times_ns[-1] - times_ns[0]) / 5e6 + 1
    assert abs(len(times_ns) - num_frames) <= 4


async def serves_again(port: int) -> None:
    """A new viewer is served after the attack."""
    async with viewing(port, "/healthy/markers") as viewer:
        await viewer.wait_for("/healthy/markers", 10)
