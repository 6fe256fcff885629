"""``rtc3d-gateway params`` and ``echo`` as separate programs, with gateways in this process."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import pytest
import rtc3d
import zenoh

from gateway.outputs.encodings import json_bytes
from gateway.outputs.lcm import parameters as lcm_parameters
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.settings import lcm_queries_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from tests.command_process import run
from tests.networks import free_endpoint, free_port, lcm_url, open_zenoh
from tests.queried_gateway import ParameterServer, ServerOfSections, run_gateway, wait_until_cached
from tests.servers import ScriptedServer
from tests.spec_parameters import spec_xml
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns


class Lab(NamedTuple):
    server: ParameterServer
    endpoint: str
    url: str

    def options(self, side: str) -> list[str]:
        """Return the options with which the command reaches this gateway on Zenoh or LCM."""
        # Without --source, the command first waits for status messages on LCM, which takes 2.5 s.
        lcm = ["--lcm", "--url", self.url, "--source", "lab"]
        return lcm if side == "lcm" else ["--connect", self.endpoint]


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


sides = pytest.mark.parametrize("side", ["zenoh", "lcm"])


@sides
async def test_a_table_is_printed_by_default(side: str) -> None:
    async with lab(ParameterServer("Left knee")) as at:
        done = await run("params", *at.options(side))
    assert (done.status, done.stderr) == (0, "")
    for text in ("lab: general", "lab: 3D, 1 marker, 100 Hz, mm", "Left knee", "lab: parameters are "):
        assert text in done.stdout


@sides
async def test_sections_are_shown_as_json(side: str) -> None:
    async with lab() as at:
        done = await run("params", "3d", "force", "--json", *at.options(side))
    assert (done.status, done.stderr) == (0, "")
    source = json.loads(done.stdout)["lab"]
    assert source["age_s"] >= 0
    assert list(source["parameters"]) == ["3d", "force"]
    assert source["parameters"]["3d"]["markers"][0]["label"].lower() == "marker 1"


@sides
@pytest.mark.parametrize("section", ["force", "events"])
async def test_the_malformed_xml_of_the_specification_is_printed_unchanged(side: str, section: str) -> None:
    async with lab(ServerOfSections()) as at:
        done = await run("params", section, "--xml", *at.options(side))
    assert (done.status, done.stderr) == (0, "")
    assert done.stdout == spec_xml(section).decode().rstrip() + "\n"


@sides
async def test_fresh_queries_the_server(side: str) -> None:
    async with lab() as at:
        requests = at.server.count("SendParameters")
        cached = await run("params", "--xml", *at.options(side))
        assert cached.stdout.encode().rstrip() == at.server.xml.rstrip()
        assert at.server.count("SendParameters") == requests
        at.server.xml = at.server.xml.replace(b"Marker 1", b"Renamed marker")
        fresh = await run("params", "--xml", "--fresh", *at.options(side))
        assert "Renamed marker" in fresh.stdout
        assert at.server.count("SendParameters") > requests


@sides
async def test_no_gateway_is_status_3(side: str) -> None:
    options = ["--connect", free_endpoint()] if side == "zenoh" else ["--lcm", "--url", lcm_url()]
    done = await run("params", *options)
    assert (done.status, done.stdout) == (3, "")
    assert "gateway" in done.stderr
    assert done.stderr.count("\n") == 1


async def test_a_router_without_a_gateway_is_status_3() -> None:
    endpoint = free_endpoint()
    router = open_zenoh("router", listen=endpoint)
    try:
        done = await run("params", "--connect", endpoint, "--timeout", "0.5")
    finally:
        router.close()
    assert done.status == 3
    assert done.stderr.startswith("no gateway found on Zenoh (mocap/*/alive); check that it is running")


async def test_a_router_that_answers_too_late_is_no_gateway() -> None:
    """As a busy one: the query ends with Zenoh's own error, and there is no gateway."""
    endpoint = free_endpoint()
    queries: list[zenoh.Query] = []
    router = open_zenoh("router", listen=endpoint)
    router.declare_queryable("mocap/**", queries.append)
    try:
        done = await run("params", "--connect", endpoint, "--timeout", "0.5")
    finally:
        queries.clear()
        router.close()
    assert done.status == 3
    assert done.stderr.startswith("no gateway found on Zenoh (mocap/*/alive); check that it is running")


@sides
async def test_a_source_that_no_gateway_serves_is_status_3(side: str) -> None:
    async with lab() as at:
        done = await run("params", "--timeout", "0.5", *at.options(side), "--source", "hall")
    assert done.status == 3
    expected = (
        "no gateway serves source 'hall'; sources found: lab"
        if side == "zenoh"
        else "no gateway found on LCM (MOCAP_HALL"
    )
    assert done.stderr.startswith(expected)


@sides
async def test_a_gateway_with_another_prefix_is_not_found(side: str) -> None:
    async with lab() as at:
        done = await run("params", "--prefix", "other", "--timeout", "0.5", *at.options(side))
    assert done.status == 3


@sides
async def test_a_gateway_without_its_server_is_status_4(side: str) -> None:
    async with lab_without_server() as (port, at):
        done = await run("params", "3d", *at.options(side))
    assert (done.status, done.stdout) == (4, "")
    assert done.stderr.startswith(f"source 'lab' has no connection: refused by 127.0.0.1:{port}, tried ")


@sides
async def test_a_server_that_does_not_answer_is_status_5(side: str) -> None:
    async with lab(reply_timeout_s=0.3) as at:
        at.server.ignored_commands = ("SendParameters",)
        done = await run("params", "--fresh", *at.options(side))
    assert done.status == 5
    assert "did not answer SendParameters within 0.3 s" in done.stderr


@sides
async def test_a_gateway_that_does_not_answer_in_time_is_status_5(side: str) -> None:
    async with lab(reply_timeout_s=20.0, query_timeout_s=20.0) as at:
        at.server.ignored_commands = ("SendParameters",)
        done = await run("params", "--fresh", "--timeout", "0.2", *at.options(side))
    assert done.status == 5
    assert "within 0.2 s although a gateway is running" in done.stderr


@sides
async def test_a_server_that_does_not_know_the_command_is_status_1(side: str) -> None:
    async with lab() as at:
        at.server.refused_commands = ("SendParameters",)
        done = await run("params", "--fresh", *at.options(side))
    assert done.status == 1
    assert "the server does not know SendParameters, or refuses it: err-unknown command" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["4d"], "unknown section '4d'; known sections: general, 3d, 6d, analog, force, events"),
        (["--zenoh", "--lcm"], "--zenoh or --lcm"),
        (["--json", "--xml"], "--json or --xml"),
        (["--timeout", "0"], "--timeout"),
        (["--nonsense"], "--nonsense"),
    ],
)
async def test_a_wrong_command_line_is_status_2(arguments: list[str], text: str) -> None:
    done = await run("params", *arguments)
    assert (done.status, done.stdout) == (2, "")
    assert text in " ".join(done.stderr.replace("│", " ").split())


async def test_a_source_without_a_server_does_not_hide_other_sources() -> None:
    endpoint, server = free_endpoint(), ParameterServer()
    router = open_zenoh("router", listen=endpoint)
    try:
        async with (
            ScriptedServer(server.script) as listening,
            run_gateway(listening.port, router=endpoint) as gateway,
            run_gateway(free_port(), router=endpoint, name="hall"),
        ):
            await wait_until_cached(gateway)
            done = await run("params", "3d", "--json", "--connect", endpoint)
    finally:
        router.close()
    assert list(json.loads(done.stdout)) == ["lab"]
    assert done.status == 4
    assert done.stderr.startswith("source 'hall' has no connection")


async def test_sources_of_the_same_name_on_two_gateways_are_both_shown() -> None:
    endpoint, first, second = (
        free_endpoint(),
        ParameterServer("of the first"),
        ParameterServer("of the second"),
    )
    router = open_zenoh("router", listen=endpoint)
    try:
        async with (
            ScriptedServer(first.script) as a,
            ScriptedServer(second.script) as b,
            run_gateway(a.port, router=endpoint) as one,
            run_gateway(b.port, router=endpoint) as other,
        ):
            await wait_until_cached(one)
            await wait_until_cached(other)
            done = await run("params", "--json", "--connect", endpoint)
    finally:
        router.close()
    assert done.status == 0
    sources = json.loads(done.stdout)
    assert list(sources) == ["lab", "lab_2"]
    labels = {source["parameters"]["3d"]["markers"][0]["label"] for source in sources.values()}
    assert labels == {"of the first", "of the second"}


async def test_several_sources_are_found_on_lcm() -> None:
    url, first, second = lcm_url(), ParameterServer("of the first"), ParameterServer("of the second")
    async with (
        ScriptedServer(first.script) as a,
        ScriptedServer(second.script) as b,
        run_gateway(a.port, lcm_url=url) as one,
        run_gateway(b.port, lcm_url=url, name="hall-2") as other,
    ):
        await wait_until_cached(one)
        await wait_until_cached(other)
        done = await run("params", "--json", "--lcm", "--url", url)
    assert (done.status, done.stderr) == (0, "")
    labels = {
        name: source["parameters"]["3d"]["markers"][0]["label"]
        for name, source in json.loads(done.stdout).items()
    }
    assert labels == {"lab": "of the first", "hall-2": "of the second"}


@pytest.mark.parametrize("code", ["", "rate", "busy"])
async def test_a_query_without_a_reply_is_repeated(code: str) -> None:
    """The first two queries get no reply, as while Zenoh reconnects, or an error; the third one does."""
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)
    queries: list[zenoh.Query] = []

    def on_query(query: zenoh.Query) -> None:
        queries.append(query)
        with query:
            if len(queries) > 2:
                query.reply("mocap/lab/parameters", spec_xml("3d"), attachment=json_bytes({"age_s": 3.5}))
            elif code:
                query.reply_err("too many queries", encoding=zenoh.Encoding("text/plain").with_schema(code))

    token = session.liveliness().declare_token("mocap/lab/alive")
    session.declare_queryable("mocap/lab/**", on_query)
    try:
        done = await run("params", "--json", "--connect", endpoint)
    finally:
        token.undeclare()
        session.close()
    assert (done.status, done.stderr) == (0, "")
    assert json.loads(done.stdout)["lab"]["age_s"] == 3.5
    assert len(queries) == 3


async def test_a_refusal_is_shown_if_there_is_no_time_left() -> None:
    endpoint = free_endpoint()
    session = open_zenoh("peer", listen=endpoint)

    def on_query(query: zenoh.Query) -> None:
        with query:
            query.reply_err("too many queries", encoding=zenoh.Encoding("text/plain").with_schema("rate"))

    token = session.liveliness().declare_token("mocap/lab/alive")
    session.declare_queryable("mocap/lab/**", on_query)
    try:
        done = await run("params", "--connect", endpoint, "--timeout", "1")
    finally:
        token.undeclare()
        session.close()
    assert (done.status, done.stdout) == (1, "")
    assert "too many queries" in done.stderr


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

    gateway = LcmSubscriber(connection, "MOCAP_LAB_PARAMETERS_REQUEST", on_request)
    try:
        done = await run("params", "--json", "--lcm", "--url", url, "--source", "lab")
    finally:
        gateway.close()
    assert (done.status, done.stderr) == (0, "")
    assert json.loads(done.stdout)["lab"]["age_s"] == 3.5


async def test_echo_prints_published_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lcm_parameters, "REPEAT_S", 0.05)
    async with lab() as at:
        echo = asyncio.create_task(
            run(
                "echo",
                "--component",
                "parameters",
                "--count",
                "1",
                "--seconds",
                "20",
                "--connect",
                at.endpoint,
            )
        )
        lcm = await run(
            "echo", "--component", "parameters", "--count", "1", "--seconds", "20", "--lcm", "--url", at.url
        )
        on_zenoh = await echo
    size = len(at.server.xml)
    assert on_zenoh.stdout.startswith(f"mocap/lab/parameters {size} bytes of XML: 1 marker, 0 tools")
    assert "session 1, version 1: " in lcm.stdout
    assert f"{size} bytes of XML: 1 marker, 0 tools" in lcm.stdout
