"""Queries for parameters over real Zenoh sessions, with and without a server."""

import asyncio
from functools import partial

import pytest
import zenoh

from gateway.messages.decode import to_json
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_endpoint
from tests.queried_gateway import (
    ParameterServer,
    ServerOfSections,
    gateway_with_server,
    gateway_without_server,
    output_queries,
    query,
    run_gateway,
    wait_until_cached,
    zenoh_peer,
)
from tests.servers import ScriptedServer
from tests.spec_parameters import BY_SECTION, markers_of, spec_xml
from tests.waiting import wait_until_async


async def test_parameters_are_answered_with_the_xml_of_the_server() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/parameters")
        assert (reply.key, reply.payload) == ("mocap/lab/parameters", server.xml)
        assert reply.encoding == "application/xml"
        assert reply.attachment["session"] == 1
        assert 0 <= reply.attachment["age_s"] < 60
        assert "stale" not in reply.attachment


@pytest.mark.parametrize("section", SECTIONS)
async def test_each_section_is_answered_as_unchanged_xml_or_as_json(section: str) -> None:
    # The examples of force and events in the specification are not well-formed.
    async with gateway_with_server(ServerOfSections()) as (_, _, _, peer):
        assert (await query(peer, f"mocap/lab/parameters/{section}")).payload == spec_xml(section)
        reply = await query(peer, f"mocap/lab/parameters/{section}?format=json")
        assert reply.encoding == "application/json"
        [expected] = [value for value in to_json(BY_SECTION[section]).values() if value is not None]
        assert reply.json == expected
        assert bool(reply.attachment["recovered"]) == (section in {"force", "events"})


async def test_all_parameters_as_json_are_one_object_of_sections() -> None:
    async with gateway_with_server(ParameterServer("Left knee")) as (_, _, _, peer):
        parameters = (await query(peer, "mocap/lab/parameters?format=json")).json
        assert list(parameters) == list(SECTIONS)
        assert [marker["label"] for marker in parameters["3d"]["markers"]] == ["Left knee"]


async def test_cached_parameters_do_not_cause_commands() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        before = list(server.commands)
        for key in ("parameters", *(f"parameters/{section}" for section in SECTIONS)):
            await query(peer, f"mocap/lab/{key}?fresh=false")
        assert server.commands == before


async def test_fresh_parameters_are_requested_from_the_server() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        server.xml = server.xml.replace(b">100<", b">250<")
        cached = await query(peer, "mocap/lab/parameters/3d?format=json")
        assert cached.json["frequency_hz"] == 100
        fresh = await query(peer, "mocap/lab/parameters/3d?fresh=true;format=json")
        assert fresh.json["frequency_hz"] == 250
        assert server.count("SendParameters") == 2


async def test_recently_received_parameters_count_as_fresh() -> None:
    async with gateway_with_server(fresh_interval_s=3600.0) as (server, _, _, peer):
        before = list(server.commands)
        assert (await query(peer, "mocap/lab/parameters?fresh=true")).payload == server.xml
        assert server.commands == before


async def test_a_thousand_simultaneous_queries_cause_one_command() -> None:
    # On a busy computer, it takes seconds until all of them have arrived.
    lab = gateway_with_server(reply_timeout_s=60.0, query_timeout_s=60.0)
    async with lab as (server, _, gateway, peer):
        before = server.count("SendParameters")
        server.may_answer.clear()
        payloads: list[bytes] = []
        ended: list[int] = []

        def append(reply: zenoh.Reply) -> None:
            assert reply.ok is not None
            payloads.append(reply.ok.payload.to_bytes())

        for number in range(1000):
            end = zenoh.handlers.Callback(append, drop=partial(ended.append, number))
            peer.get("mocap/lab/parameters?fresh=true", end, timeout=60)
        queries = output_queries(gateway)
        await wait_until_async(lambda: queries._admission.num_pending == 1000)
        server.may_answer.set()
        await wait_until_async(lambda: len(ended) == 1000)
        assert payloads == [server.xml] * 1000
        assert server.count("SendParameters") == before + 1


async def test_a_server_that_refuses_single_sections_is_asked_for_all() -> None:
    server = ParameterServer()
    server.xml = server.xml.replace(b"<Events/>", b"<Events>")  # not well-formed
    server.refused_commands = ("SendParameters ",)
    async with gateway_with_server(server) as (_, _, _, peer):
        assert (await query(peer, "mocap/lab/parameters/3d")).payload == server.xml
        markers = (await query(peer, "mocap/lab/parameters/3d?format=json")).json
        assert [marker["label"] for marker in markers["markers"]] == ["Marker 1"]


async def test_a_section_is_taken_from_the_reply_with_all_parameters() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        xml = (await query(peer, "mocap/lab/parameters/3d")).payload
        assert [marker.label for marker in markers_of(xml).markers] == ["Marker 1"]
        markers = (await query(peer, "mocap/lab/parameters/3d?format=json")).json
        assert [marker["label"] for marker in markers["markers"]] == ["Marker 1"]
        assert server.count("SendParameters") == 1


async def test_a_missing_section_as_json_is_an_error() -> None:
    server = ServerOfSections()
    server.sections["events"] = b"<RT_Parameters Ver='1.00'/>"
    async with gateway_with_server(server) as (_, _, _, peer):
        reply = await query(peer, "mocap/lab/parameters/events?format=json")
        assert (reply.code, reply.error) == ("nothing-yet", "the server's answer has no section events")


async def test_unreadable_xml_is_answered_unchanged() -> None:
    server = ServerOfSections()
    server.sections["3d"] = b"It is 3 o'clock."
    async with gateway_with_server(server) as (_, _, _, peer):
        assert (await query(peer, "mocap/lab/parameters/3d")).payload == b"It is 3 o'clock."
        reply = await query(peer, "mocap/lab/parameters/3d?format=json")
        assert reply.code == "unreadable"
        assert "ask without format=json" in reply.error


async def test_without_a_connection_stale_parameters_are_answered_with_their_age() -> None:
    server, endpoint = ParameterServer(), free_endpoint()
    async with ScriptedServer(server.script) as listening:
        context = run_gateway(listening.port, listen=endpoint)
        gateway = await context.__aenter__()
        await wait_until_cached(gateway)
    try:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: "refused" in status.last_error)
        with zenoh_peer(endpoint) as peer:
            assert (await query(peer, "mocap/lab/parameters")).code == "no-connection"
            reply = await query(peer, "mocap/lab/parameters?stale=ok")
            assert reply.payload == server.xml
            assert reply.attachment["stale"] is True
            assert reply.attachment["age_s"] > 0
            assert reply.attachment["session"] == 1
            reply = await query(peer, "mocap/lab/parameters/3d?stale=ok;format=json;fresh=true")
            assert reply.json["markers"]
    finally:
        await context.__aexit__(None, None, None)


@pytest.mark.parametrize("key", ["parameters", "parameters/3d", "parameters?stale=ok", "3d", "event"])
async def test_without_a_connection_the_error_has_the_reason_and_its_age(key: str) -> None:
    async with gateway_without_server() as (port, peer):
        reply = await query(peer, f"mocap/lab/{key}")
        assert reply.encoding == "text/plain;no-connection"
        start, separator, age = reply.error.partition(", tried ")
        assert start == f"source 'lab' has no connection: refused by 127.0.0.1:{port}"
        assert separator
        assert age.split(" s ago; ")[1] == "is the RT server running, and is this its port?"
        assert 0 <= float(age.split()[0]) < 60


async def test_the_refusal_of_send_parameters_is_reported_and_cached() -> None:
    server = ParameterServer()
    server.refused_commands = ("SendParameters",)
    endpoint = free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint) as gateway,
    ):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        with zenoh_peer(endpoint) as peer:
            reply = await query(peer, "mocap/lab/parameters")
            assert reply.code == "refused"
            assert reply.error == (
                "source 'lab': the server does not know SendParameters, or refuses it: err-unknown command"
            )
            num_requests = server.count("SendParameters")
            assert (await query(peer, "mocap/lab/parameters")).error == reply.error
            assert server.count("SendParameters") == num_requests  # cached for the connection
            assert (await query(peer, "mocap/lab/parameters?fresh=true")).error == reply.error
            assert server.count("SendParameters") == num_requests + 1
            frame = await query(peer, "mocap/lab/3d?format=json")
            assert frame.json["markers"][0]["x"] == 1


async def test_a_server_without_a_reply_leads_to_a_timeout_error() -> None:
    async with gateway_with_server(reply_timeout_s=0.3) as (server, port, _, peer):
        server.ignored_commands = ("SendParameters",)
        reply = await query(peer, "mocap/lab/parameters?fresh=true")
        assert reply.code == "timeout"
        assert reply.error == (f"source 'lab': 127.0.0.1:{port} did not answer SendParameters within 0.3 s")
        assert (await query(peer, "mocap/lab/parameters")).payload == server.xml


async def test_queries_that_wait_too_long_for_others_get_a_timeout_error() -> None:
    async with gateway_with_server(query_timeout_s=0.3, reply_timeout_s=20.0) as (server, _, _, peer):
        server.ignored_commands = ("SendParameters",)
        replies = await asyncio.gather(
            *(query(peer, f"mocap/lab/parameters/{section}?fresh=true") for section in SECTIONS)
        )
        assert {reply.code for reply in replies} == {"timeout"}
        waited = "source 'lab': no answer within 0.3 s; queries waiting for the server: "
        assert all(reply.error.startswith(waited) for reply in replies)


async def test_losing_the_connection_during_a_query_is_an_error() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        server.may_answer.clear()
        reply_task = asyncio.create_task(query(peer, "mocap/lab/parameters?fresh=true"))
        before = server.count("SendParameters")
        await wait_until_async(lambda: server.count("SendParameters") > before)
        assert server.client is not None
        server.client.cut()
        reply = await reply_task
        assert reply.code == "no-connection"
        assert "source 'lab' has just lost its connection: the connection to 127.0.0.1:" in reply.error
        server.may_answer.set()
