"""``rtc3d-gateway list`` as a program of its own, with gateways in this process."""

import asyncio
import json
import os
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
import zenoh

from gateway.outputs.lcm.connection import open_lcm
from gateway.stream.state import StreamState
from tests.command_process import run
from tests.integration.commands.test_params_command import Lab, lab_without_server
from tests.networks import free_endpoint, lcm_url, open_zenoh
from tests.pseudo_terminals import in_terminal
from tests.queried_gateway import ParameterServer, run_gateway
from tests.servers import ScriptedServer
from tests.waiting import wait_until_async

pytestmark = [pytest.mark.netns, pytest.mark.asyncio(loop_scope="module")]
sides = pytest.mark.parametrize("side", ["zenoh", "lcm"])


@pytest_asyncio.fixture(name="at", scope="module", loop_scope="module")
async def streaming_lab() -> AsyncIterator[Lab]:
    """A gateway whose newest status says that it streams."""
    server, endpoint, url = ParameterServer(), free_endpoint(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, lcm_url=url) as gateway,
    ):
        [source] = gateway.sources
        await wait_until_async(lambda: source.statuses[0].state is StreamState.STREAMING)
        source.publish_status()
        yield Lab(server, endpoint, url)


def options(at: Lab, side: str) -> list[str]:
    return ["--lcm", "--url", at.url] if side == "lcm" else ["--connect", at.endpoint]


@sides
async def test_a_source_is_listed_with_its_server_and_state(at: Lab, side: str) -> None:
    """Scripts read columns or JSON; both name the source, its server and its state."""
    done = await run("list", *options(at, side))
    as_json = await run("list", "--json", *options(at, side))
    assert (done.status, done.stderr, done.stdout.count("\n")) == (0, "", 1)
    name, state, components, server, host, version = done.stdout.rstrip("\n").split("\t")
    assert (name, components, server.partition(":")[0]) == (
        "lab",
        "3d 6d analog force event",
        "127.0.0.1",
    )
    assert state.startswith("streaming ")
    assert host == os.uname().nodename
    assert version
    [source] = json.loads(as_json.stdout)["sources"]
    assert (source["source"], source["server"], source["problem"]) == ("lab", server, "")
    assert bool(source["gateway"]) is (side == "zenoh")


@sides
async def test_a_source_without_its_server_has_the_words_of_the_status_line(side: str) -> None:
    async with lab_without_server() as (port, at):
        done = await run("list", *options(at, side))
    assert done.status == 0
    assert done.stdout.split("\t")[1].startswith(f"waiting for 127.0.0.1:{port}")


@sides
async def test_without_a_gateway_the_status_is_3_and_the_sentence_that_of_params(side: str) -> None:
    place = ["--lcm", "--url", lcm_url()] if side == "lcm" else ["--connect", free_endpoint()]
    listed, as_json, params = await asyncio.gather(
        run("list", *place), run("list", "--json", *place), run("params", *place)
    )
    assert (listed.status, listed.stdout) == (3, "")
    assert (as_json.status, json.loads(as_json.stdout)) == (3, {"sources": [], "num_left_out": 0})
    assert listed.stderr == as_json.stderr == params.stderr != ""


@sides
async def test_a_source_that_does_not_exist_is_status_3_with_those_that_do(at: Lab, side: str) -> None:
    """A typing error is told apart from a gateway that does not run."""
    done = await run("list", "--source", "hall", *options(at, side))
    other_prefix = await run("list", "--prefix", "other", *options(at, side))
    assert (done.status, done.stdout) == (3, "")
    assert done.stderr == "no gateway serves source 'hall'; sources found: lab\n"
    assert other_prefix.status == 3
    assert "no gateway found" in other_prefix.stderr


@sides
async def test_two_gateways_with_the_same_source_are_both_listed(at: Lab, side: str) -> None:
    """They disturb each other, so the user must see both, with their servers."""
    async with (
        ScriptedServer(ParameterServer().script) as listening,
        run_gateway(listening.port, router=at.endpoint, lcm_url=at.url) as second,
    ):
        await wait_until_async(lambda: second.sources[0].sequence > 1)
        done = await run("list", "--json", *options(at, side))
    assert done.status == 0
    sources = json.loads(done.stdout)["sources"]
    assert [source["source"] for source in sources] == ["lab", "lab"]
    assert len({source["server"] for source in sources}) == 2
    assert "2 gateways serve a source 'lab'" in done.stderr


async def test_a_source_whose_gateway_does_not_answer_is_listed_as_such(at: Lab) -> None:
    """A gateway that hangs must not vanish from the list."""
    ghost = await asyncio.to_thread(open_zenoh, "client", connect=at.endpoint)
    token = ghost.liveliness().declare_token("mocap/ghost/alive")
    try:
        done = await run("list", *options(at, "zenoh"))
    finally:
        token.undeclare()
        ghost.close()
    assert done.status == 0
    lines = [line.split("\t") for line in done.stdout.splitlines()]
    assert [line[0] for line in lines] == ["ghost", "lab"]
    assert lines[0][1] == "its gateway does not answer"


async def test_hostile_answers_do_not_hide_a_gateway(at: Lab) -> None:
    """Other programs on the network can neither hide a gateway nor write to the terminal."""
    evil = await asyncio.to_thread(open_zenoh, "client", connect=at.endpoint)
    tokens = [evil.liveliness().declare_token(f"mocap/evil{number}/alive") for number in range(3)]
    payloads = {"evil0": b"\x1b[2J", "evil1": bytes(3_000_000), "evil2": b""}

    def answer(query: zenoh.Query) -> None:
        for name, payload in payloads.items():
            query.reply(f"mocap/{name}/status", payload)

    evil.declare_queryable("mocap/*/status", answer)
    try:
        done = await run("list", *options(at, "zenoh"))
    finally:
        for token in tokens:
            token.undeclare()
        evil.close()
    assert done.status == 0
    lines = dict(line.split("\t", 1) for line in done.stdout.splitlines())
    assert list(lines) == ["evil0", "evil1", "evil2", "lab"]
    assert lines["evil0"].startswith("its status is of another version of rtc3d-gateway")
    assert lines["evil1"].startswith("its status is too long: 3000000 bytes")
    assert lines["lab"].startswith("streaming ")
    assert "\x1b" not in done.stdout


async def test_messages_of_other_programs_on_lcm_are_listed_as_unreadable(at: Lab) -> None:
    """A gateway of another version is seen although its status cannot be read."""
    other = open_lcm(at.url)
    task = asyncio.create_task(run("list", *options(at, "lcm")))
    while not task.done():
        other.publish("MOCAP_OLD_STATUS", b"another version")
        other.publish("MOCAP_HALL_LAB_STATUS_X", b"no status")
        await asyncio.sleep(0.05)
    done = await task
    lines = dict(line.split("\t", 1) for line in done.stdout.splitlines())
    assert sorted(lines) == ["lab", "old"]
    assert lines["old"].startswith("its status is of another version of rtc3d-gateway")


async def test_on_a_terminal_a_table_is_printed(at: Lab) -> None:
    """The columns have titles and fit the terminal."""
    with in_terminal("list", "--connect", at.endpoint, columns=80, TERM="dumb") as terminal:
        assert await asyncio.to_thread(terminal.wait_for_end) == 0
    text = terminal.output.decode()
    assert text.split()[:6] == ["source", "state", "components", "server", "host", "version"]
    assert max(map(len, text.splitlines())) <= 80
