"""Parameters asked for over real Zenoh sessions, of servers of every kind, and of none."""

import asyncio
from functools import partial

import pytest
import zenoh

from gateway.messages.decode import to_json
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_endpoint
from tests.querying import (
    LabServer,
    ask,
    asker_at,
    gateway_at,
    is_filled,
    lab,
    lab_without_server,
    queries_of,
)
from tests.servers import ScriptedServer
from tests.spec_parameters import BY_SECTION, spec_xml
from tests.waiting import wait_until_async


async def test_parameters_come_as_the_servers_xml() -> None:
    async with lab() as (server, _, _, asker):
        reply = await ask(asker, "mocap/lab/parameters")
        assert (reply.key, reply.payload) == ("mocap/lab/parameters", server.xml)
        assert reply.encoding == "application/xml"
        assert reply.attachment["session"] == 1
        assert 0 <= reply.attachment["age_s"] < 60
        assert "stale" not in reply.attachment


@pytest.mark.parametrize("section", SECTIONS)
async def test_each_section_travels_verbatim_as_xml_and_correctly_as_json(section: str) -> None:
    # The specification's own examples of force and events are not well-formed.
    async with lab() as (_, _, _, asker):
        assert (await ask(asker, f"mocap/lab/parameters/{section}")).payload == spec_xml(section)
        reply = await ask(asker, f"mocap/lab/parameters/{section}?format=json")
        assert reply.encoding == "application/json"
        [expected] = [part for part in to_json(BY_SECTION[section]).values() if part is not None]
        assert reply.json == expected
        assert bool(reply.attachment["recovered"]) == (section in {"force", "events"})


async def test_all_parameters_as_json_are_one_object_of_sections() -> None:
    async with lab(LabServer("Left knee")) as (_, _, _, asker):
        parameters = (await ask(asker, "mocap/lab/parameters?format=json")).json
        assert list(parameters) == list(SECTIONS)
        assert [marker["label"] for marker in parameters["3d"]["markers"]] == ["Left knee"]


async def test_what_is_known_does_not_cost_the_server_a_command() -> None:
    async with lab() as (server, _, _, asker):
        before = list(server.commands)
        for key in ("parameters", *(f"parameters/{section}" for section in SECTIONS)):
            await ask(asker, f"mocap/lab/{key}?fresh=false")
        assert server.commands == before


async def test_fresh_parameters_are_the_servers_of_now() -> None:
    async with lab() as (server, _, _, asker):
        server.sections["3d"] = b"<RT_Parameters><The_3D><Frequency>250</Frequency></The_3D></RT_Parameters>"
        assert (await ask(asker, "mocap/lab/parameters/3d")).payload == spec_xml("3d")
        fresh = await ask(asker, "mocap/lab/parameters/3d?fresh=true;format=json")
        assert fresh.json["frequency_hz"] == 250
        assert server.count("SendParameters 3D") >= 2


async def test_parameters_that_were_just_asked_for_count_as_fresh() -> None:
    async with lab(fresh_interval_s=3600.0) as (server, _, _, asker):
        before = list(server.commands)
        assert (await ask(asker, "mocap/lab/parameters?fresh=true")).payload == server.xml
        assert server.commands == before


async def test_a_thousand_who_ask_at_once_cost_the_server_one_command() -> None:
    async with lab() as (server, _, gateway, asker):
        before = server.count("SendParameters")
        server.open.clear()
        payloads: list[bytes] = []
        ended: list[int] = []

        def take(reply: zenoh.Reply) -> None:
            assert reply.ok is not None
            payloads.append(reply.ok.payload.to_bytes())

        for number in range(1000):
            end = zenoh.handlers.Callback(take, drop=partial(ended.append, number))
            asker.get("mocap/lab/parameters?fresh=true", end, timeout=30)
        queries = queries_of(gateway)
        await wait_until_async(lambda: len(queries._tasks) == 1000)
        server.open.set()
        await wait_until_async(lambda: len(ended) == 1000, timeout_s=30)
        assert payloads == [server.xml] * 1000
        assert server.count("SendParameters") == before + 1


async def test_a_server_without_single_sections_gives_all_for_one() -> None:
    server = LabServer()
    server.refused = ("SendParameters ",)
    async with lab(server) as (_, _, _, asker):
        assert (await ask(asker, "mocap/lab/parameters/3d")).payload == server.xml
        markers = (await ask(asker, "mocap/lab/parameters/3d?format=json")).json
        assert [marker["label"] for marker in markers["markers"]] == ["Marker 1"]


async def test_a_server_that_sends_all_whatever_is_asked_gives_all_for_one() -> None:
    server = LabServer()
    server.sections = {}
    async with lab(server) as (_, _, _, asker):
        markers = (await ask(asker, "mocap/lab/parameters/3d?format=json")).json
        assert [marker["label"] for marker in markers["markers"]] == ["Marker 1"]


async def test_a_section_that_the_server_does_not_have_is_said_not_to_be_there() -> None:
    server = LabServer()
    server.sections["events"] = b"<RT_Parameters Ver='1.00'/>"
    async with lab(server) as (_, _, _, asker):
        reply = await ask(asker, "mocap/lab/parameters/events?format=json")
        assert (reply.code, reply.error) == ("nothing-yet", "the server's answer has no section events")


async def test_xml_that_cannot_be_read_still_comes_as_it_is() -> None:
    server = LabServer()
    server.sections["3d"] = b"It is 3 o'clock."
    async with lab(server) as (_, _, _, asker):
        assert (await ask(asker, "mocap/lab/parameters/3d")).payload == b"It is 3 o'clock."
        reply = await ask(asker, "mocap/lab/parameters/3d?format=json")
        assert reply.code == "unreadable"
        assert "ask without format=json" in reply.error


async def test_stale_parameters_come_while_the_server_is_away_with_their_age() -> None:
    server, endpoint = LabServer(), free_endpoint()
    async with ScriptedServer(server.script) as listening:
        context = gateway_at(listening.port, listen=endpoint)
        gateway = await context.__aenter__()
        await is_filled(gateway, server)
    try:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: "refused" in status.last_error)
        with asker_at(endpoint) as asker:
            assert (await ask(asker, "mocap/lab/parameters")).code == "no-connection"
            reply = await ask(asker, "mocap/lab/parameters?stale=ok")
            assert reply.payload == server.xml
            assert reply.attachment["stale"] is True
            assert reply.attachment["age_s"] > 0
            assert reply.attachment["session"] == 1
            reply = await ask(asker, "mocap/lab/parameters/3d?stale=ok;format=json;fresh=true")
            assert reply.json["markers"]
    finally:
        await context.__aexit__(None, None, None)


@pytest.mark.parametrize("key", ["parameters", "parameters/3d", "parameters?stale=ok", "3d", "event"])
async def test_without_a_connection_the_reason_is_told_and_since_when(key: str) -> None:
    async with lab_without_server() as (port, asker):
        reply = await ask(asker, f"mocap/lab/{key}")
        assert reply.encoding == "text/plain;no-connection"
        start, separator, age = reply.error.partition(", tried ")
        assert start == f"source 'lab' has no connection: refused by 127.0.0.1:{port}"
        assert separator
        assert age.split(" s ago; ")[1] == "is the RT server running, and is this its port?"
        assert 0 <= float(age.split()[0]) < 60


async def test_a_server_that_does_not_know_send_parameters_leads_to_that_sentence() -> None:
    server = LabServer()
    server.refused = ("SendParameters",)
    endpoint = free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        gateway_at(listening.port, listen=endpoint) as gateway,
    ):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest)
        with asker_at(endpoint) as asker:
            reply = await ask(asker, "mocap/lab/parameters")
            assert reply.code == "refused"
            assert reply.error == (
                "source 'lab': the server does not know SendParameters, or refuses it: err-unknown command"
            )
            asked = server.count("SendParameters")
            assert (await ask(asker, "mocap/lab/parameters")).error == reply.error
            assert server.count("SendParameters") == asked  # remembered as long as the connection
            assert (await ask(asker, "mocap/lab/parameters?fresh=true")).error == reply.error
            assert server.count("SendParameters") == asked + 1
            frame = await ask(asker, "mocap/lab/3d?format=json")
            assert frame.json["markers"][0]["x"] == 1


async def test_a_server_that_does_not_answer_leads_to_an_error_before_the_asker_gives_up() -> None:
    async with lab(reply_timeout_s=0.3) as (server, port, _, asker):
        server.silent = ("SendParameters",)
        reply = await ask(asker, "mocap/lab/parameters?fresh=true")
        assert reply.code == "timeout"
        assert reply.error == (f"source 'lab': 127.0.0.1:{port} did not answer SendParameters within 0.3 s")
        assert (await ask(asker, "mocap/lab/parameters")).payload == server.xml


async def test_questions_that_wait_too_long_for_others_are_told_so() -> None:
    async with lab(query_timeout_s=0.3, reply_timeout_s=20.0) as (server, _, _, asker):
        server.silent = ("SendParameters",)
        replies = await asyncio.gather(
            *(ask(asker, f"mocap/lab/parameters/{section}?fresh=true") for section in SECTIONS)
        )
        assert {reply.code for reply in replies} == {"timeout"}
        waited = "source 'lab': no answer within 0.3 s; queries waiting for the server: "
        assert all(reply.error.startswith(waited) for reply in replies)


async def test_a_connection_lost_while_the_server_is_asked_is_told() -> None:
    async with lab() as (server, _, _, asker):
        server.open.clear()
        asked = asyncio.create_task(ask(asker, "mocap/lab/parameters?fresh=true"))
        before = server.count("SendParameters")
        await wait_until_async(lambda: server.count("SendParameters") > before)
        assert server.client is not None
        server.client.cut()
        reply = await asked
        assert reply.code == "no-connection"
        assert "source 'lab' has just lost its connection: the connection to 127.0.0.1:" in reply.error
        server.open.set()
