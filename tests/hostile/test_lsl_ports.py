"""Attacks on the ports of LSL, which are open on every network interface: nobody else notices."""

import asyncio
import contextlib
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.hostile.gateway_under_attack import GatewayUnderAttack
from tests.hostile.lsl_attacks import LSL_ATTACKS, LslAttack
from tests.lsl_receiver import LslReceiver, lsl_config
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

ATTACK_S: Final = 4.0
MAX_PROCESS_KIB: Final = 900 * 1024
MAX_GROWTH_KIB: Final = 100 * 1024
TIMEOUT_S: Final = 60.0


def memory_kib(process_id: int) -> int:
    """Return the memory of the process for LSL of a gateway; 0 if there is none at the moment."""
    listed = subprocess.run(["pgrep", "-P", str(process_id)], capture_output=True, text=True, check=False)
    total = 0
    for child in listed.stdout.split():
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/{child}/status").read_text().splitlines():
                if line.startswith("VmRSS:"):
                    total += int(line.split()[1])
    return total


async def attacking(attack: LslAttack) -> None:
    await attack()


@pytest.mark.parametrize("name", LSL_ATTACKS)
async def test_attacks_on_the_ports_disturb_nobody_else(
    name: str, gateway_under_attack: GatewayUnderAttack, tmp_path: Path
) -> None:
    config = lsl_config(tmp_path)
    settings = {"lsl": {"enabled": True, "config": str(config)}}
    async with gateway_under_attack(settings=settings) as gateway:
        before = LslReceiver(config, "healthy_3d")
        await wait_until_async(lambda: before.samples["healthy_3d"], TIMEOUT_S)
        attack = asyncio.create_task(attacking(LSL_ATTACKS[name]))
        most_kib = 0
        for _ in range(int(ATTACK_S / 0.1)):
            await asyncio.sleep(0.1)
            assert not attack.done(), attack
            most_kib = max(most_kib, memory_kib(gateway.process.pid))
        attack.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await attack
        after = LslReceiver(config, "healthy_3d")
        await wait_until_async(lambda: after.samples["healthy_3d"], TIMEOUT_S)
        for receiver in (before, after):
            receiver.close()
    gateway.report.check()
    assert most_kib < MAX_PROCESS_KIB
    assert gateway.report.rss_after_kib < gateway.report.rss_before_kib + MAX_GROWTH_KIB
