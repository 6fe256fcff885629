"""``rtc3d-gateway echo`` as a program of its own: what does not exist, silence, single tools and rates."""

import asyncio
import json
import os
import pty
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import NamedTuple

import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.command_process import run
from tests.networks import free_endpoint, lcm_url, open_zenoh
from tests.queried_gateway import run_gateway
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns
sides = pytest.mark.parametrize("side", ["zenoh", "lcm"])


class Place(NamedTuple):
    """Where the messages of the gateway are."""

    endpoint: str
    url: str


def options(at: Place, side: str) -> list[str]:
    return ["--lcm", "--url", at.url] if side == "lcm" else ["--connect", at.endpoint]


@asynccontextmanager
async def lab(*, tool_poses: bool = False) -> AsyncIterator[Place]:
    """Run a simulator with two tools, and a gateway with a stream of 3d, 6d and event, which streams."""
    place = Place(free_endpoint(), lcm_url())
    scene = SyntheticScene(markers=2, tools=2, analog=0, plates=0, rate_hz=100)
    components = (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.EVENT)
    async with (
        Simulator(scene) as simulator,
        run_gateway(
            simulator.port,
            listen=place.endpoint,
            lcm_url=place.url,
            tool_poses=tool_poses,
            streams=(StreamSettings(components=components),),
        ) as gateway,
    ):
        [source] = gateway.sources
        await wait_until_async(lambda: source.statuses[0].state is StreamState.STREAMING)
        source.publish_status()
        yield place


@sides
async def test_an_unknown_source_is_an_error_with_those_that_exist(side: str) -> None:
    async with lab() as at:
        done = await run("echo", "--source", "hall", *options(at, side))
    assert (done.status, done.stdout) == (3, "")
    assert done.stderr == "no gateway serves source 'hall'; sources found: lab\n"


@sides
@pytest.mark.parametrize("hz", [[], ["--hz"]])
async def test_a_component_that_no_source_has_is_an_error_with_those_that_exist(
    side: str, hz: list[str]
) -> None:
    async with lab() as at:
        done = await run("echo", "--component", "force", *hz, *options(at, side))
    assert (done.status, done.stdout) == (3, "")
    assert done.stderr == (
        "no force from lab; accepted for --component: 3d, 6d, event, status, clock or parameters\n"
    )


@sides
async def test_an_unknown_tool_is_an_error_with_those_that_exist(side: str) -> None:
    async with lab() as at:
        done = await run("echo", "--component", "6d/Nothing", *options(at, side))
    assert (done.status, done.stdout) == (3, "")
    assert done.stderr == "no gateway has a tool 'Nothing'; tools found: Tool 1, Tool 2\n"


@sides
async def test_silence_of_a_source_is_said_once_with_its_state(side: str) -> None:
    async with lab() as at:
        done = await run("echo", "--component", "c3d", "--seconds", "6", *options(at, side))
    assert (done.status, done.stdout) == (0, "")
    assert done.stderr.startswith("nothing heard of c3d although a gateway runs (lab: streaming ")
    assert done.stderr.count("\n") == 1


async def test_without_a_gateway_the_sentence_of_params_is_said_and_later_messages_are_printed() -> None:
    endpoint = free_endpoint()
    router = await asyncio.to_thread(open_zenoh, "router", listen=endpoint)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "gateway", "echo", "--connect", endpoint, "--component", "status"),
        *("--count", "2"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert process.stderr is not None
        said = await asyncio.wait_for(process.stderr.readline(), 60)
        params = await run("params", "--connect", endpoint, "--timeout", "0.5")
        assert said.decode() == params.stderr
        async with run_gateway(1, router=endpoint):
            stdout, stderr = await asyncio.wait_for(process.communicate(), 60)
    finally:
        router.close()
    assert (process.returncode, stderr) == (0, b"")
    assert stdout.count(b"mocap/lab/status") == 2


async def test_on_lcm_the_sentence_is_that_of_params_too() -> None:
    url = lcm_url()
    echo, params = await asyncio.gather(
        run("echo", "--lcm", "--url", url, "--seconds", "8"), run("params", "--lcm", "--url", url)
    )
    assert (echo.status, echo.stdout) == (0, "")
    assert echo.stderr == params.stderr != ""


@sides
async def test_the_poses_of_one_tool_are_printed(side: str) -> None:
    async with lab(tool_poses=True) as at:
        done = await run("echo", "--component", "6d/Tool 2", "--count", "3", *options(at, side))
    assert (done.status, done.stderr) == (0, "")
    name = "MOCAP_LAB_6D_TOOL_2" if side == "lcm" else "mocap/lab/6d/Tool%202"
    assert [line.split(" ")[0] for line in done.stdout.splitlines()] == [name] * 3


@sides
async def test_rates_are_those_of_the_server(side: str) -> None:
    async with lab(tool_poses=True) as at:
        command = ("echo", "--hz", "--json", "--seconds", "3", "--component", "3d")
        done = await run(*command, *options(at, side))
    assert (done.status, done.stderr) == (0, "")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) >= 2
    assert rows[-1]["window"] > 10
    assert rows[-1]["rate_hz"] > 0


async def test_on_a_terminal_the_table_of_rates_is_refreshed_in_place() -> None:
    async with lab(tool_poses=True) as at:
        reader, writer = pty.openpty()
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "gateway", "echo", "--hz", "--seconds", "3", "--connect", at.endpoint),
            stdout=writer,
            env=os.environ | {"COLUMNS": "100", "TERM": "xterm"},
        )
        os.close(writer)
        assert await process.wait() == 0
        text = os.read(reader, 100_000).decode()
        os.close(reader)
    assert "mocap/lab/3d" in text
    assert "\x1b[1A" in text, "the cursor goes up to write the table again"


async def test_fewer_messages_than_count_are_status_1_with_hz_too() -> None:
    async with lab() as at:
        arguments = ("--component", "status", "--count", "1000", "--seconds", "2", *options(at, "zenoh"))
        done = await run("echo", "--hz", *arguments)
    assert done.status == 1
    assert "of 1000 messages arrived within 2 s" in done.stderr
