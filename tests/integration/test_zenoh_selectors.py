"""Selectors over real Zenoh sessions: mistakes, wildcards, several sources, a router."""

from pathlib import Path

import pytest

from gateway.config.settings import StreamSettings
from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_endpoint, open_zenoh
from tests.queried_gateway import (
    ParameterServer,
    gateway_with_server,
    gateway_without_server,
    query,
    query_all,
    run_gateway,
    wait_until_cached,
    zenoh_peer,
)
from tests.servers import ScriptedServer, c3d_file, packet
from tests.waiting import wait_until_async


@pytest.mark.parametrize(
    ("selector", "accepted"),
    [
        ("parameters/4d", ["unknown section '4d'", *SECTIONS]),
        ("parameters/3d/more", ["unknown key 'parameters/3d/more'", "parameters/3d", "status"]),
        ("markers", ["unknown key 'markers'", "parameters", "3d", "recording", "schema/TYPE"]),
        ("alive", ["unknown key 'alive'"]),
        ("analog", ["component 'analog' is not configured for this source; accepted: 3d, event"]),
        ("schema/tools", ["unknown type", "tools_t", "parameters_reply_t"]),
        ("schema", ["unknown type", "markers_t"]),
        ("parameters?format=yaml", ["format='yaml' is not accepted; accepted: xml, json"]),
        ("parameters?fresh=yes", ["fresh='yes' is not accepted; accepted: true, false"]),
        ("parameters?fresh", ["fresh='' is not accepted"]),
        ("3d?fresh=true", ["unknown option 'fresh' of component; accepted: format=lcm|json"]),
        ("c3d?format=json", ["unknown option 'format' of c3d; accepted: none"]),
        ("parameters?a=b", ["unknown option 'a'", "format=xml|json, fresh=true|false, stale=ok"]),
        ("*?format=yaml", ["format='yaml' is not accepted; accepted: xml, json, lcm"]),
        ("*?a=b", ["unknown option 'a' of parameters, component, status", "format=", "stale=ok"]),
        ("*/nonsense", ["nothing of source 'lab' matches mocap/lab/*/nonsense", "parameters/3d"]),
    ],
)  # fmt: skip
async def test_the_error_for_a_bad_query_lists_what_is_accepted(selector: str, accepted: list[str]) -> None:
    streams = (StreamSettings(components=(ComponentType.MARKERS, ComponentType.EVENT)),)
    async with gateway_without_server(streams=streams) as (_, peer):
        reply = await query(peer, f"mocap/lab/{selector}")
        assert reply.encoding == "text/plain;bad-request"
        assert [text for text in accepted if text not in reply.error] == []
        assert "\n" not in reply.error


async def test_a_query_for_the_source_alone_gets_a_list_of_keys() -> None:
    async with gateway_without_server() as (_, peer):
        reply = await query(peer, "mocap/lab")
        assert reply.code == "bad-request"
        assert "accepted below mocap/lab/: parameters, " in reply.error


async def test_options_of_zenoh_itself_are_ignored() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        assert (await query(peer, "mocap/lab/parameters?_anyke;_time=[now(-1s)..]")).payload == server.xml


async def test_a_wildcard_is_answered_by_every_key_that_has_an_answer() -> None:
    async with gateway_with_server() as (server, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        replies = {reply.key: reply for reply in await query_all(peer, "mocap/lab/*?format=json")}
        assert set(replies) == {"mocap/lab/parameters", "mocap/lab/3d", "mocap/lab/status"}
        assert {reply.encoding for reply in replies.values()} == {"application/json"}
        assert replies["mocap/lab/3d"].json["frame_number"] == 7
        assert server.count("SendCurrentFrame") == 0


async def test_a_wildcard_does_not_select_files_and_recording(tmp_path: Path) -> None:
    async with gateway_with_server(spool=tmp_path, remote_control=True) as (server, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        server.send(packet(5, c3d_file(b"a file")))
        await wait_until_async(lambda: list(tmp_path.glob("*.c3d")))
        keys = [reply.key for reply in await query_all(peer, "mocap/**")]
        expected = ["parameters", *(f"parameters/{section}" for section in SECTIONS), "3d", "status"]
        expected += [f"schema/{name}" for name in SCHEMA_TYPES]
        assert sorted(keys) == sorted(f"mocap/lab/{key}" for key in expected)


async def test_a_wildcard_without_any_answer_gets_an_error() -> None:
    async with gateway_without_server() as (port, peer):
        reply = await query(peer, "mocap/*/3d")
        assert reply.code == "no-connection"
        assert f"refused by 127.0.0.1:{port}" in reply.error


async def test_a_wildcard_for_sources_is_answered_by_every_source() -> None:
    router = free_endpoint()
    router_session = open_zenoh("router", listen=router)
    first, second = ParameterServer("of the first"), ParameterServer("of the second")
    try:
        async with (
            ScriptedServer(first.script) as first_server,
            ScriptedServer(second.script) as second_server,
            run_gateway(first_server.port, router=router) as lab_gateway,
            run_gateway(second_server.port, router=router, name="hall") as hall_gateway,
        ):
            await wait_until_cached(lab_gateway)
            await wait_until_cached(hall_gateway)
            with zenoh_peer(router) as peer:
                replies = {reply.key: reply for reply in await query_all(peer, "mocap/*/parameters")}
                assert replies["mocap/lab/parameters"].payload == first.xml
                assert replies["mocap/hall/parameters"].payload == second.xml
    finally:
        router_session.close()


async def test_queries_work_through_a_router() -> None:
    router, server = free_endpoint(), ParameterServer()
    router_session = open_zenoh("router", listen=router)
    try:
        async with (
            ScriptedServer(server.script) as listening,
            run_gateway(listening.port, router=router) as gateway,
        ):
            await wait_until_cached(gateway)
            await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
            with zenoh_peer(router) as peer:
                assert (await query(peer, "mocap/lab/parameters")).payload == server.xml
                fresh = await query(peer, "mocap/lab/parameters/3d?fresh=true;format=json")
                assert fresh.json["markers"][0]["label"] == "Marker 1"
                assert (await query(peer, "mocap/*/3d?format=json")).json["frame_number"] == 7
                assert (await query(peer, "mocap/lab/markers")).code == "bad-request"
                assert (await query(peer, "mocap/lab/schema/marker_t")).payload
    finally:
        router_session.close()
