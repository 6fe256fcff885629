"""``echo`` and ``list`` as programs, and what all commands say if there is no gateway or no such source."""

import asyncio
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
import zenoh

from gateway.config.settings import StreamSettings
from gateway.outputs.lcm.connection import open_lcm
from gateway.rtc3d.components import ComponentType
from gateway.session.state import StreamState
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.integration.commands.test_params_command import SIDES, Lab, lab_without_server
from tests.support.commands import run
from tests.support.errors import names
from tests.support.networks import free_endpoint, lcm_url, open_zenoh
from tests.support.pseudo_terminals import in_terminal
from tests.support.queried_gateway import ParameterServer, run_gateway, wait_until_cached
from tests.support.waiting import wait_until_async

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


# Without a gateway or a source ---------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES)
async def test_without_a_gateway_all_commands_say_the_same(side: str) -> None:
    """Scripts see a status and one line with what to check; only echo waits for a gateway."""
    place = Lab(ParameterServer(), free_endpoint(), lcm_url())
    commands = ["list", "params", "top", "top --once", "top --once --json", "take stop"]
    commands += ["echo --seconds 8", "list --json"]
    router = await asyncio.to_thread(open_zenoh, "router", listen=place.endpoint)
    with contextlib.closing(router):
        ended = await asyncio.gather(*(run(*each.split(), *place.options(side)) for each in commands))
    assert [done.status for done in ended] == [3, 3, 3, 3, 3, 3, 0, 3]
    assert {done.stdout for done in ended[:-1]} == {""}
    assert json.loads(ended[-1].stdout) == {"sources": [], "num_left_out": 0}
    [sentence] = {done.stderr for done in ended}
    assert names(sentence, "no gateway")
    assert sentence.count("\n") == 1


async def test_a_source_that_nobody_serves_is_named_with_those_that_exist(lab: Lab) -> None:
    """A user sees whether a name is mistyped or the gateway does not run."""
    commands = [(side, name) for side in SIDES for name in ("list", "echo")]
    commands += [("zenoh", "top --once"), ("zenoh", "params --timeout 3")]
    ended = await asyncio.gather(
        *(run(*name.split(), *lab.options(side), "--source", "hall") for side, name in commands)
    )
    assert {(status, output) for status, output, _ in ended} == {(3, "")}
    assert all(names(error, "'hall'", "lab") for _, _, error in ended)


# echo ----------------------------------------------------------------------------------------


async def test_what_does_not_exist_is_an_error_with_what_exists(lab: Lab) -> None:
    """A typing error in an option must not look like silence; the message helps to correct it."""
    no_force = "no force from lab; accepted for --component: 3d, 6d, event, status, clock or parameters\n"
    cases = {
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
        assert names(done.stderr, "c3d", "lab: streaming")
        assert done.stderr.count("\n") == 1


async def test_echo_prints_the_messages_of_a_gateway_that_starts_later() -> None:
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
        assert (await asyncio.wait_for(process.stderr.readline(), 60)).startswith(b"no gateway found")
        async with run_gateway(1, router=endpoint):
            stdout, stderr = await asyncio.wait_for(process.communicate(), 60)
    finally:
        router.close()
    assert (process.returncode, stderr) == (0, b"")
    assert stdout.count(b"mocap/lab/status") == 2


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
        await wait_until_async(lambda: gateway.sources[0].history.parameters_version)
        for component, end in (("3d", ") mm"), ("analog", " mV"), ("force", ") N")):
            for done in await place.run("echo", "--component", component, "--count", "20"):
                assert (done.status, done.stderr) == (0, "")
                assert [line.endswith(end) for line in done.stdout.splitlines()] == [True] * 20
        for output in gateway.outputs:
            assert output.query_results is not None
            assert 3 <= output.query_results["lab"]["ok"] < 20


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
    assert names(done.stderr, "1000 messages", "1 s")


# list ----------------------------------------------------------------------------------------


async def test_a_source_is_listed_with_its_server_and_state(lab: Lab) -> None:
    """Scripts read columns or JSON; both name the source, its server and its state."""
    listed, as_json = await asyncio.gather(lab.run("list"), lab.run("list", "--json"))
    for side, done, objects in zip(SIDES, listed, as_json, strict=True):
        assert (done.status, done.stderr, done.stdout.count("\n")) == (0, "", 1)
        name, state, components, server, host, version, routers = done.stdout.rstrip("\n").split("\t")
        assert routers == ""
        assert (name, components, host) == ("lab", "3d 6d event", os.uname().nodename)
        assert server.partition(":")[0] == "127.0.0.1"
        assert state.startswith("streaming ")
        assert version
        [source] = json.loads(objects.stdout)["sources"]
        assert (source["source"], source["server"], source["problem"]) == ("lab", server, "")
        assert bool(source["gateway"]) is (side == "zenoh")


async def test_a_source_without_its_server_has_the_words_of_the_status_line() -> None:
    async with lab_without_server() as (port, alone):
        for done in await alone.run("list"):
            assert done.status == 0
            assert done.stdout.split("\t")[1].startswith(f"waiting for 127.0.0.1:{port}")


async def test_hostile_or_missing_answers_do_not_hide_a_gateway(lab: Lab) -> None:
    """Other programs can neither hide a gateway nor write to the terminal; one that hangs is listed, too."""
    payloads = {"evil0": b"\x1b[2J", "evil1": bytes(3_000_000), "evil2": b""}

    def answer(query: zenoh.Query) -> None:
        for name, payload in payloads.items():
            query.reply(f"mocap/{name}/status", payload)

    evil = await asyncio.to_thread(open_zenoh, "client", connect=lab.endpoint)
    with contextlib.closing(evil):
        tokens = [evil.liveliness().declare_token(f"mocap/{name}/alive") for name in (*payloads, "ghost")]
        evil.declare_queryable("mocap/*/status", answer)
        done = await run("list", *lab.options("zenoh"))
        for token in tokens:
            token.undeclare()
    assert done.status == 0
    lines = dict(line.split("\t", 1) for line in done.stdout.splitlines())
    assert list(lines) == ["evil0", "evil1", "evil2", "ghost", "lab"]
    assert names(lines["evil0"], "status", "version")
    assert names(lines["evil1"], "status", "3000000 bytes")
    assert names(lines["ghost"], "gateway", "answer")
    assert lines["lab"].startswith("streaming ")
    assert "\x1b" not in done.stdout


async def test_messages_of_other_programs_on_lcm_are_listed_as_unreadable(lab: Lab) -> None:
    """A gateway of another version is seen although its status cannot be read."""
    other = open_lcm(lab.url)
    task = asyncio.create_task(run("list", *lab.options("lcm")))
    while not task.done():
        other.publish("MOCAP_OLD_STATUS", b"another version")
        other.publish("MOCAP_HALL_LAB_STATUS_X", b"no status")
        await asyncio.sleep(0.05)
    lines = dict(line.split("\t", 1) for line in (await task).stdout.splitlines())
    assert sorted(lines) == ["lab", "old"]
    assert names(lines["old"], "status", "version")
