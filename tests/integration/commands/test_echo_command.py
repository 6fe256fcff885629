"""``rtc3d-gateway echo`` as a program of its own: what does not exist, silence, single tools and rates."""

import asyncio
import json
import subprocess
import sys
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio

from gateway.config.settings import StreamSettings
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.command_process import run
from tests.integration.commands.test_params_command import Lab
from tests.networks import free_endpoint, lcm_url, open_zenoh
from tests.pseudo_terminals import in_terminal
from tests.queried_gateway import ParameterServer, run_gateway, wait_until_cached
from tests.waiting import wait_until_async

pytestmark = [pytest.mark.netns, pytest.mark.asyncio(loop_scope="module")]


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def lab() -> AsyncIterator[Lab]:
    """A gateway with tool poses and one stream of 3d, 6d and event, from a simulator with two tools."""
    place = Lab(ParameterServer(), free_endpoint(), lcm_url())
    scene = SyntheticScene(markers=2, tools=2, analog=0, plates=0, rate_hz=100)
    components = (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.EVENT)
    async with (
        Simulator(scene) as simulator,
        run_gateway(
            simulator.port,
            listen=place.endpoint,
            lcm_url=place.url,
            tool_poses=True,
            streams=(StreamSettings(components=components),),
        ) as gateway,
    ):
        [source] = gateway.sources
        await wait_until_async(lambda: source.statuses[0].state is StreamState.STREAMING)
        source.publish_status()
        yield place


async def test_what_does_not_exist_is_an_error_with_what_exists(lab: Lab) -> None:
    """A typing error in an option must not look like silence; the message helps to correct it."""
    no_force = "no force from lab; accepted for --component: 3d, 6d, event, status, clock or parameters\n"
    cases = {
        ("--source", "hall"): "no gateway serves source 'hall'; sources found: lab\n",
        ("--component", "force"): no_force,
        ("--component", "force", "--hz"): no_force,
        ("--component", "6d/Nothing"): "no gateway has a tool 'Nothing'; tools found: Tool 1, Tool 2\n",
    }
    ended = await asyncio.gather(*(lab.run("echo", *case) for case in cases))
    for error, done in zip(cases.values(), ended, strict=True):
        assert done == [(3, "", error)] * 2


async def test_silence_of_a_source_is_said_once_with_its_state(lab: Lab) -> None:
    """The user learns that the gateway runs, and that only this component is silent."""
    for done in await lab.run("echo", "--component", "c3d", "--seconds", "9"):
        assert (done.status, done.stdout) == (0, "")
        assert done.stderr.startswith("nothing heard of c3d although a gateway runs (lab: streaming ")
        assert done.stderr.count("\n") == 1


async def test_without_a_gateway_the_sentence_of_params_is_said_and_later_messages_are_printed() -> None:
    """Both commands describe the same state alike, and echo goes on."""
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
    """On LCM only silence shows that there is no gateway."""
    url = lcm_url()
    echo, params = await asyncio.gather(
        run("echo", "--lcm", "--url", url, "--seconds", "8"), run("params", "--lcm", "--url", url)
    )
    assert (echo.status, echo.stdout) == (0, "")
    assert echo.stderr == params.stderr != ""


async def test_the_poses_of_one_tool_are_printed(lab: Lab) -> None:
    """A tool of a name with a space is found on either network; nothing of other tools is printed."""
    ended = await lab.run("echo", "--component", "6d/Tool 2", "--count", "3")
    for name, done in zip(("mocap/lab/6d/Tool%202", "MOCAP_LAB_6D_TOOL_2"), ended, strict=True):
        assert (done.status, done.stderr) == (0, "")
        assert [line.split(" ")[0] for line in done.stdout.splitlines()] == [name] * 3


async def test_values_have_the_units_of_the_parameters_which_are_asked_for_once() -> None:
    """A position of 1.5 may be in metres or millimetres. A query per message would slow the gateway down."""
    place = Lab(ParameterServer(), free_endpoint(), lcm_url())
    scene = SyntheticScene(markers=2, tools=0, analog=2, plates=1, rate_hz=100, analog_rate_hz=100)
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, listen=place.endpoint, lcm_url=place.url) as gateway,
    ):
        await wait_until_cached(gateway)
        await wait_until_async(lambda: gateway.sources[0].parameters_version)
        for component, end in (("3d", ") mm"), ("analog", " mV"), ("force", ") N")):
            for done in await place.run("echo", "--component", component, "--count", "20"):
                assert (done.status, done.stderr) == (0, "")
                assert [line.endswith(end) for line in done.stdout.splitlines()] == [True] * 20
        for output in gateway.outputs:
            results = output.query_results
            assert results is not None
            assert 3 <= results["lab"]["ok"] < 20


async def test_rates_count_the_messages_of_the_component(lab: Lab) -> None:
    """Ten messages end the command however slow the machine is; only those of 3d are in the figures."""
    for done in await lab.run("echo", "--hz", "--json", "--count", "10", "--component", "3d"):
        assert (done.status, done.stderr) == (0, "")
        last = json.loads(done.stdout.splitlines()[-1])
        assert last["window"] == 10
        assert last["rate_hz"] > 0


async def test_on_a_terminal_the_table_of_rates_is_refreshed_in_place(lab: Lab) -> None:
    """The cursor goes up to write the table again."""
    with in_terminal("echo", "--hz", "--connect", lab.endpoint) as terminal:
        await asyncio.to_thread(terminal.wait_for, lambda text: "mocap/lab/3d" in text and "\x1b[1A" in text)


async def test_fewer_messages_than_count_are_status_1_with_hz_too(lab: Lab) -> None:
    """A script notices that the data did not come."""
    arguments = ("--component", "status", "--count", "1000", "--seconds", "1", *lab.options("zenoh"))
    done = await run("echo", "--hz", *arguments)
    assert done.status == 1
    assert "of 1000 messages arrived within 1 s" in done.stderr
