"""``rtc3d-gateway list`` as a program of its own, with gateways in this process."""

import asyncio
import contextlib
import json
import os
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
import zenoh

from gateway.outputs.lcm.connection import open_lcm
from gateway.stream.state import StreamState
from tests.command_process import run
from tests.integration.commands.test_params_command import SIDES, Lab, lab_without_server
from tests.networks import free_endpoint, lcm_url, open_zenoh
from tests.queried_gateway import ParameterServer, run_gateway
from tests.servers import ScriptedServer
from tests.waiting import wait_until_async

pytestmark = [pytest.mark.netns, pytest.mark.asyncio(loop_scope="module")]


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


async def test_a_source_is_listed_with_its_server_and_state(at: Lab) -> None:
    """Scripts read columns or JSON; both name the source, its server and its state."""
    listed, as_json = await asyncio.gather(at.run("list"), at.run("list", "--json"))
    for side, done, objects in zip(SIDES, listed, as_json, strict=True):
        assert (done.status, done.stderr, done.stdout.count("\n")) == (0, "", 1)
        name, state, components, server, host, version = done.stdout.rstrip("\n").split("\t")
        assert (name, components, host) == ("lab", "3d 6d analog force event", os.uname().nodename)
        assert server.partition(":")[0] == "127.0.0.1"
        assert state.startswith("streaming ")
        assert version
        [source] = json.loads(objects.stdout)["sources"]
        assert (source["source"], source["server"], source["problem"]) == ("lab", server, "")
        assert bool(source["gateway"]) is (side == "zenoh")


async def test_a_source_without_its_server_has_the_words_of_the_status_line() -> None:
    async with lab_without_server() as (port, at):
        for done in await at.run("list"):
            assert done.status == 0
            assert done.stdout.split("\t")[1].startswith(f"waiting for 127.0.0.1:{port}")


async def test_without_a_gateway_the_status_is_3_and_the_sentence_that_of_params() -> None:
    nobody = Lab(ParameterServer(), free_endpoint(), lcm_url())
    commands = (("list",), ("list", "--json"), ("params",))
    for ended in zip(*await asyncio.gather(*(nobody.run(*command) for command in commands)), strict=True):
        listed, as_json, params = ended
        assert (listed.status, listed.stdout, as_json.status) == (3, "", 3)
        assert json.loads(as_json.stdout) == {"sources": [], "num_left_out": 0}
        assert listed.stderr == as_json.stderr == params.stderr != ""


async def test_a_source_that_does_not_exist_is_status_3_with_those_that_do(at: Lab) -> None:
    """A typing error is told apart from a gateway that does not run."""
    for done in await at.run("list", "--source", "hall"):
        assert done == (3, "", "no gateway serves source 'hall'; sources found: lab\n")
    for done in await at.run("list", "--prefix", "other"):
        assert done.status == 3
        assert "no gateway found" in done.stderr


async def test_hostile_or_missing_answers_do_not_hide_a_gateway(at: Lab) -> None:
    """Other programs can neither hide a gateway nor write to the terminal; one that hangs is listed, too."""
    payloads = {"evil0": b"\x1b[2J", "evil1": bytes(3_000_000), "evil2": b""}

    def answer(query: zenoh.Query) -> None:
        for name, payload in payloads.items():
            query.reply(f"mocap/{name}/status", payload)

    evil = await asyncio.to_thread(open_zenoh, "client", connect=at.endpoint)
    with contextlib.closing(evil):
        tokens = [evil.liveliness().declare_token(f"mocap/{name}/alive") for name in (*payloads, "ghost")]
        evil.declare_queryable("mocap/*/status", answer)
        done = await run("list", *at.options("zenoh"))
        for token in tokens:
            token.undeclare()
    assert done.status == 0
    lines = dict(line.split("\t", 1) for line in done.stdout.splitlines())
    assert list(lines) == ["evil0", "evil1", "evil2", "ghost", "lab"]
    assert lines["evil0"].startswith("its status is of another version of rtc3d-gateway")
    assert lines["evil1"].startswith("its status is too long: 3000000 bytes")
    assert lines["ghost"].startswith("its gateway does not answer\t")
    assert lines["lab"].startswith("streaming ")
    assert "\x1b" not in done.stdout


async def test_messages_of_other_programs_on_lcm_are_listed_as_unreadable(at: Lab) -> None:
    """A gateway of another version is seen although its status cannot be read."""
    other = open_lcm(at.url)
    task = asyncio.create_task(run("list", *at.options("lcm")))
    while not task.done():
        other.publish("MOCAP_OLD_STATUS", b"another version")
        other.publish("MOCAP_HALL_LAB_STATUS_X", b"no status")
        await asyncio.sleep(0.05)
    lines = dict(line.split("\t", 1) for line in (await task).stdout.splitlines())
    assert sorted(lines) == ["lab", "old"]
    assert lines["old"].startswith("its status is of another version of rtc3d-gateway")
