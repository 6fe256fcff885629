"""Peers that start, stop, save and read takes without end: the healthy source loses nothing."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import rtc3d

from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from tests.hostile.gateway_under_attack import GatewayUnderAttack, RunningGateway
from tests.hostile.test_askers import MAX_GROWTH_MIB, ask, still_answers, wait_for_frames
from tests.support.gateway_process import simulator

pytestmark = pytest.mark.netns


@pytest.fixture(scope="module")
def server() -> Iterator[int]:
    """The port of the server whose takes are attacked."""
    with simulator("--rate", "200", "--analog-rate", "200") as (port, _):
        yield port


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "takes"
    folder.mkdir()
    return folder


@asynccontextmanager
async def attacked(run: GatewayUnderAttack, port: int, folder: Path) -> AsyncIterator[RunningGateway]:
    """Run a gateway that takes commands; it must answer them still at the end of the attack."""
    takes = {"enabled": True, "directory": str(folder), "keep_last_s": 10.0}
    async with run({"lab": {"port": port, "remote_control": True}}, {"takes": takes}) as gateway:
        await wait_for_frames(gateway)
        yield gateway
        await still_answers(gateway, "mocap/lab/take")
    gateway.report.check(MAX_GROWTH_MIB)
    assert len(list((folder / "lab").glob("*"))) < 4 * 60


async def test_floods_of_commands_on_zenoh(
    server: int, folder: Path, gateway_under_attack: GatewayUnderAttack
) -> None:
    commands = (
        *("set=start;name={}", "set=stop", "set=save;last=10;after=3600;name=s{}", "set=save", "set=start"),
        *("read={};offset=0", "read=x;offset=-1", "read=x;offset=nan", "set=start;name=" + 900 * "x"),
        *(
            "set=save;last=nan",
            "set=save;last=1e9",
            "set=stop;name={}",
            "x{}=1",
            "set={}",
            "read=../lab{}",
            "",
        ),
    )
    async with attacked(gateway_under_attack, server, folder) as gateway:
        selectors = [f"mocap/lab/take?{command}" for command in commands]
        wildcards = [f"mocap/{key}?set=start" for key in ("**", "*/take", "lab/*", "lab/t$*")]
        replies, _ = await asyncio.gather(ask(gateway, 6000, *selectors), ask(gateway, 2000, *wildcards))
        assert replies["bad-request"] > 0
        assert replies["rate"] > 0


async def test_floods_of_reads_on_zenoh(
    server: int, folder: Path, gateway_under_attack: GatewayUnderAttack
) -> None:
    async with attacked(gateway_under_attack, server, folder) as gateway:
        (folder / "lab").mkdir(exist_ok=True)
        with (folder / "lab/long.lcmlog").open("wb") as file:
            file.truncate(2_000_000_000)
        selector = "mocap/lab/take?read=long;offset={}"
        replies = await ask(gateway, 4000, f"{selector}000", f"{selector}000000", f"{selector}00000000000")
        assert replies["ok"] > 0
        assert replies["rate"] > 0


async def test_floods_of_commands_on_lcm(
    server: int, folder: Path, gateway_under_attack: GatewayUnderAttack
) -> None:
    request = rtc3d.command_request_t()
    request.requester, request.command = "flood", "take"
    async with attacked(gateway_under_attack, server, folder) as gateway:
        connection = open_lcm(lcm_queries_url(gateway.lcm_url))
        options = [
            ["set=start"],
            ["set=stop"],
            ["set=save"],
            [],
            ["read=x"],
            ["x" * 3000],
            ["set=start"] * 300,
        ]
        for number in range(100):  # 1 s
            for each in options * 10:
                request.request_id = number
                request.options, request.num_options = each, len(each)
                connection.publish("MOCAP_LAB_COMMAND_REQUEST", request.encode())
            await asyncio.sleep(0.01)
