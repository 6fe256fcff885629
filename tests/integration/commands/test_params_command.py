"""``rtc3d-gateway params`` as a program of its own, with gateways in this process."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, Final, NamedTuple

import pytest
import rtc3d
import zenoh

from gateway.messages.decode import json_bytes
from gateway.outputs.lcm import output as lcm_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.support.commands import Completed, run, run_in_process
from tests.support.errors import names
from tests.support.networks import free_endpoint, free_port, lcm_url, open_zenoh
from tests.support.parameters import spec_xml
from tests.support.queried_gateway import ParameterServer, run_gateway, wait_until_cached, wait_until_found
from tests.support.servers import ScriptedServer
from tests.support.waiting import wait_until_async

pytestmark = pytest.mark.netns

SIDES: Final = ("zenoh", "lcm")


class Lab(NamedTuple):
    """A gateway on Zenoh and LCM, and the server of its source."""

    server: ParameterServer
    endpoint: str
    url: str

    def options(self, side: str, *of_lcm: str) -> list[str]:
        """Return the options with which a command reaches this gateway on Zenoh or LCM."""
        return ["--lcm", "--url", self.url, *of_lcm] if side == "lcm" else ["--connect", self.endpoint]

    async def run(self, *arguments: str, of_lcm: tuple[str, ...] = ()) -> list[Completed]:
        """Run a command on Zenoh and on LCM at the same time."""
        return await asyncio.gather(*(run(*arguments, *self.options(side, *of_lcm)) for side in SIDES))

    async def params(self, *arguments: str) -> list[Completed]:
        # Without --source, the command first waits for status messages on LCM, which takes 1.5 s.
        return await self.run("params", *arguments, of_lcm=("--source", "lab"))


@asynccontextmanager
async def lab(server: ParameterServer | None = None, **settings: Any) -> AsyncIterator[Lab]:
    server, endpoint, url = server or ParameterServer(), free_endpoint(), lcm_url()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, lcm_url=url, **settings) as gateway,
    ):
        await wait_until_cached(gateway)
        yield Lab(server, endpoint, url)


@asynccontextmanager
async def lab_without_server() -> AsyncIterator[tuple[int, Lab]]:
    port, endpoint, url = free_port(), free_endpoint(), lcm_url()
    async with run_gateway(port, listen=endpoint, lcm_url=url) as gateway:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.last_error)
        yield port, Lab(ParameterServer(), endpoint, url)


def labels(done: Completed) -> dict[str, str]:
    """Return the label of the first marker of each source."""
    sources = json.loads(done.stdout)
    return {name: each["parameters"]["3d"]["markers"][0]["label"] for name, each in sources.items()}


async def test_parameters_are_printed_as_lines_as_json_and_fresh_as_xml() -> None:
    async with lab(ParameterServer("Left knee")) as at:
        for done in await at.params():
            assert done.status == 0
            assert done.stderr.startswith("lab: parameters are ")
            assert "lab\tgeneral\t" in done.stdout
            assert re.search(r"^lab\t3d\t1\t.*Left knee", done.stdout, re.MULTILINE)
        for done in await at.params("3d", "force", "--json"):
            assert (done.status, done.stderr, labels(done)) == (0, "", {"lab": "Left knee"})
            assert list(json.loads(done.stdout)["lab"]["parameters"]) == ["3d", "force"]
        requests = at.server.count("SendParameters")
        for done in await at.params("--xml"):
            assert done.stdout.encode().rstrip() == at.server.xml.rstrip()
        assert at.server.count("SendParameters") == requests
        at.server.xml = at.server.xml.replace(b"Left knee", b"Renamed marker")
        for side in SIDES:
            done = await run("params", "--xml", "--fresh", *at.options(side, "--source", "lab"))
            assert "Renamed marker" in done.stdout
            assert at.server.count("SendParameters") > requests
            requests = at.server.count("SendParameters")


@pytest.mark.parametrize("is_late", [False, True], ids=["no gateway", "an answer that comes too late"])
async def test_a_router_without_a_gateway_is_status_3(is_late: bool) -> None:
    """Also with a busy router: the query ends with Zenoh's own error."""
    endpoint = free_endpoint()
    queries: list[zenoh.Query] = []
    with contextlib.closing(open_zenoh("router", listen=endpoint)) as router:
        if is_late:
            router.declare_queryable("mocap/**", queries.append)
        done = await run("params", "--connect", endpoint, "--timeout", "0.5")
        queries.clear()
    assert done.status == 3
    assert names(done.stderr, "Zenoh (mocap/*/alive)")


async def test_a_source_or_prefix_that_no_gateway_serves_is_status_3() -> None:
    async with lab() as at:
        missing = await at.run("params", "--timeout", "3", "--source", "hall")
        elsewhere = await at.params("--prefix", "other", "--timeout", "0.5")
    assert {done.status for done in (*missing, *elsewhere)} == {3}
    on_zenoh, on_lcm = (done.stderr for done in missing)
    assert names(on_zenoh, "'hall'", "lab")
    assert names(on_lcm, "LCM")
    assert "MOCAP_HALL" in on_lcm


async def test_a_gateway_without_its_server_is_status_4() -> None:
    async with lab_without_server() as (port, at):
        for done in await at.params("3d"):
            assert (done.status, done.stdout) == (4, "")
            assert names(done.stderr, "'lab'", "no connection", f"127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("settings", "refuses", "timeout_s", "status", "text"),
    [
        ({"reply_timeout_s": 0.3}, False, 10, 5, "SendParameters within 0.3 s"),
        (
            *({"reply_timeout_s": 20.0, "query_timeout_s": 20.0}, False, 0.2),
            *(5, "within 0.2 s although a gateway is running"),
        ),
        ({}, True, 10, 1, "err-unknown command"),
    ],
    ids=["the server is silent", "the gateway is silent", "the server refuses"],
)
async def test_fresh_parameters_that_do_not_come(
    settings: dict[str, Any], refuses: bool, timeout_s: float, status: int, text: str
) -> None:
    async with lab(**settings) as at:
        if refuses:
            at.server.refused_commands = ("SendParameters",)
        else:
            at.server.ignored_commands = ("SendParameters",)
        for done in await at.params("--fresh", "--timeout", str(timeout_s)):
            assert done.status == status
            assert text in done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["4d"], "general, 3d, 6d, analog, force, events"),
        (["--json", "--xml"], "--json or --xml"),
        (["--timeout", "0"], "--timeout"),
    ],
)
def test_a_wrong_command_line_is_status_2(arguments: list[str], text: str) -> None:
    done = run_in_process("params", *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert text in " ".join(done.stderr.replace("│", " ").split())


async def test_sources_of_several_gateways_are_shown_and_one_without_a_server_hides_no_other() -> None:
    """On Zenoh also two with the same name."""
    endpoint, url = free_endpoint(), lcm_url()
    servers = ParameterServer("of the first"), ParameterServer("of the second")
    with contextlib.closing(open_zenoh("router", listen=endpoint)) as router:
        async with (
            ScriptedServer(servers[0].script) as a,
            ScriptedServer(servers[1].script) as b,
            run_gateway(a.port, router=endpoint, lcm_url=url) as one,
        ):
            await wait_until_cached(one)
            async with run_gateway(b.port, router=endpoint) as other:
                await wait_until_cached(other)
                await wait_until_found(router, "lab", 2)
                same = await run("params", "--json", "--connect", endpoint)
            async with run_gateway(b.port, lcm_url=url, name="hall-2") as other:
                await wait_until_cached(other)
                several = await run("params", "--json", "--lcm", "--url", url)
            async with run_gateway(free_port(), router=endpoint, name="hall"):
                await wait_until_found(router, "hall")
                partly = await run("params", "3d", "--json", "--connect", endpoint)
    assert (same.status, list(labels(same))) == (0, ["lab", "lab_2"])
    assert set(labels(same).values()) == {"of the first", "of the second"}
    assert (several.status, several.stderr) == (0, "")
    assert labels(several) == {"lab": "of the first", "hall-2": "of the second"}
    assert (partly.status, list(labels(partly))) == (4, ["lab"])
    assert names(partly.stderr, "'hall'", "no connection")


@pytest.mark.parametrize("code", ["", "rate", "busy"])
@pytest.mark.parametrize("answered", [True, False])
async def test_a_query_without_a_reply_is_repeated(code: str, answered: bool) -> None:
    """Queries get no reply, as while Zenoh reconnects, or an error. The third gets one, or time runs out."""
    endpoint = free_endpoint()
    queries: list[zenoh.Query] = []

    def on_query(query: zenoh.Query) -> None:
        queries.append(query)
        with query:
            if answered and len(queries) > 2:
                query.reply("mocap/lab/parameters", spec_xml("3d"), attachment=json_bytes({"age_s": 3.5}))
            elif code:
                query.reply_err("too many queries", encoding=zenoh.Encoding("text/plain").with_schema(code))

    with contextlib.closing(open_zenoh("peer", listen=endpoint)) as session:
        token = session.liveliness().declare_token("mocap/lab/alive")
        session.declare_queryable("mocap/lab/**", on_query)
        timeout = () if answered else ("--timeout", "5" if code else "1")
        done = await run("params", "--json", "--connect", endpoint, *timeout)
        token.undeclare()
    if answered:
        assert (done.status, done.stderr, len(queries)) == (0, "", 3)
        assert json.loads(done.stdout)["lab"]["age_s"] == 3.5
    else:
        assert done.status == (1 if code else 5)
        assert names(done.stderr, "too many") is bool(code)


async def test_a_request_on_lcm_is_repeated_after_a_refusal() -> None:
    url = lcm_url()
    connection = open_lcm(lcm_queries_url(url))
    requests: list[bytes] = []

    def on_request(_channel: str, data: bytes) -> None:
        requests.append(data)
        request, reply = rtc3d.parameters_request_t.decode(data), rtc3d.parameters_reply_t()
        reply.request_id, reply.requester = request.request_id, request.requester
        if len(requests) < 3:
            reply.error, reply.error_code = "too many requests", "rate"
        else:
            reply.xml, reply.age_s = spec_xml("3d").decode(), 3.5
        connection.publish("MOCAP_LAB_PARAMETERS_REPLY", reply.encode())

    with contextlib.closing(LcmSubscriber(connection, "MOCAP_LAB_PARAMETERS_REQUEST", on_request)):
        done = await run("params", "--json", "--lcm", "--url", url, "--source", "lab")
    assert (done.status, done.stderr) == (0, "")
    assert json.loads(done.stdout)["lab"]["age_s"] == 3.5


async def test_echo_prints_published_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lcm_parameters, "REPEAT_S", 0.05)
    async with lab() as at:
        on_zenoh, on_lcm = await at.run(
            "echo", "--component", "parameters", "--count", "1", "--seconds", "20"
        )
    text = f"{len(at.server.xml)} bytes of XML: 1 marker, 0 tools"
    assert on_zenoh.stdout.startswith(f"mocap/lab/parameters {text}")
    assert "session 1, version 1: " in on_lcm.stdout
    assert text in on_lcm.stdout
