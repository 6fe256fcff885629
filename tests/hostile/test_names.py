"""Eight names that nobody resolves delay no other source, no reload, and not the end."""

import asyncio
import json
import signal
from pathlib import Path
from typing import Final

import pytest
import yaml

from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.name_server import dead_name_server
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

_DEAD = {f"dead-{number}": {"host": f"dead-{number}.example.org", "port": 3020} for number in range(8)}


AT_ONCE_S: Final = 20.0
"""What waits for the name server takes longer: a program asks it again after 30 s."""


def num_threads(gateway: RunningGateway) -> int:
    return len(list(Path(f"/proc/{gateway.process.pid}/task").iterdir()))


async def test_eight_dead_names_and_a_dead_name_server(
    gateway_under_attack: GatewayUnderAttack, tmp_path: Path
) -> None:
    settings = {"metrics": {"address": "dead.example.org"}}
    with dead_name_server(tmp_path) as before_command:
        async with gateway_under_attack(_DEAD, settings, before_command=before_command) as gateway:
            await wait_until_async(lambda: "was not resolved within 1 s" in gateway.log)
            threads_before = num_threads(gateway)
            configuration = yaml.safe_load(gateway.config.read_text())
            configuration["sources"][1]["port"] = 3030
            gateway.config.write_text(yaml.safe_dump(configuration))
            gateway.process.send_signal(signal.SIGHUP)
            await wait_until_async(
                lambda: "configuration reloaded: source dead-0 changed" in gateway.log, AT_ONCE_S
            )
            await asyncio.sleep(2)  # several attempts of each source
            assert num_threads(gateway) <= threads_before
    gateway.report.check()
    assert gateway.report.stop_s < AT_ONCE_S


async def test_dead_names_of_zenoh_peers(gateway_under_attack: GatewayUnderAttack, tmp_path: Path) -> None:
    endpoints = [f"tcp/dead-{number}.example.org:7447" for number in range(4)]
    environ = {"RTC3D_GATEWAY__ZENOH__CONFIG__CONNECT__ENDPOINTS": json.dumps(endpoints)}
    with dead_name_server(tmp_path) as before_command:
        async with gateway_under_attack(environ=environ, before_command=before_command) as gateway:
            await asyncio.sleep(3)
    gateway.report.check()
    assert gateway.report.stop_s < AT_ONCE_S
