"""A source that alone is more than the gateway can do: its neighbours do not notice."""

import asyncio
from pathlib import Path
from typing import Any, Final

import pytest

from tests.gateway_process import simulator
from tests.hostile.gateway_under_attack import GatewayUnderAttack, printed, python
from tests.networks import free_port

pytestmark = pytest.mark.netns

SUBSCRIBER: Final = """
import json, sys, zenoh

from tests.networks import zenoh_keys

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
