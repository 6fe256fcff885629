"""Selectors over real Zenoh sessions: what is asked wrongly, wildcards, several sources, a router between."""

from pathlib import Path

import pytest

from gateway.config.settings import StreamSettings
from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.networks import free_endpoint, open_zenoh
from tests.querying import LabServer, ask, ask_all, asker_at, gateway_at, is_filled, lab, lab_without_server
from tests.servers import ScriptedServer, packet
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
async def test_a_bad_question_is_answered_with_what_is_accepted(selector: str, accepted: list[str]) -> None:
    streams = (StreamSettings(components=(ComponentType.MARKERS, ComponentType.EVENT)),)
    async with lab_without_server(streams=streams) as (_, asker):
        reply = await ask(asker, f"mocap/lab/{selector}")
        assert reply.encoding == "text/plain;bad-request"
        assert [text for text in accepted if text not in reply.error] == []
        assert "\n" not in reply.error


async def test_the_source_alone_is_answered_with_what_is_below_it() -> None:
    async with lab_without_server() as (_, asker):
        reply = await ask(asker, "mocap/lab")
        assert reply.code == "bad-request"
        assert "accepted below mocap/lab/: parameters, " in reply.error


async def test_an_option_of_zenohs_own_is_not_ours() -> None:
    async with lab() as (server, _, _, asker):
        assert (await ask(asker, "mocap/lab/parameters?_anyke;_time=[now(-1s)..]")).payload == server.xml


async def test_a_star_is_answered_by_everything_that_has_an_answer() -> None:
    async with lab() as (server, _, gateway, asker):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest)
        replies = {reply.key: reply for reply in await ask_all(asker, "mocap/lab/*?format=json")}
        assert set(replies) == {"mocap/lab/parameters", "mocap/lab/3d", "mocap/lab/status"}
        assert {reply.encoding for reply in replies.values()} == {"application/json"}
        assert replies["mocap/lab/3d"].json["frame_number"] == 7
        assert server.count("SendCurrentFrame") == 0


async def test_everything_can_be_asked_for_but_files_and_recording(tmp_path: Path) -> None:
    async with lab(spool=tmp_path, remote_control=True) as (server, _, gateway, asker):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest)
        server.send(packet(5, b"a file"))
        await wait_until_async(lambda: list(tmp_path.glob("*.c3d")))
        keys = [reply.key for reply in await ask_all(asker, "mocap/**")]
        expected = ["parameters", *(f"parameters/{section}" for section in SECTIONS), "3d", "status"]
        expected += [f"schema/{name}" for name in SCHEMA_TYPES]
        assert sorted(keys) == sorted(f"mocap/lab/{key}" for key in expected)


async def test_a_wildcard_with_no_answer_at_all_gives_the_reason() -> None:
    async with lab_without_server() as (port, asker):
        reply = await ask(asker, "mocap/*/3d")
        assert reply.code == "no-connection"
        assert f"refused by 127.0.0.1:{port}" in reply.error


async def test_every_source_answers_a_wildcard_for_sources() -> None:
    router = free_endpoint()
    middle = open_zenoh("router", listen=router)
    first, second = LabServer("of the first"), LabServer("of the second")
    try:
        async with (
            ScriptedServer(first.script) as a,
            ScriptedServer(second.script) as b,
            gateway_at(a.port, router=router) as lab_gateway,
            gateway_at(b.port, router=router, name="hall") as hall_gateway,
        ):
            await is_filled(lab_gateway, first)
            await is_filled(hall_gateway, second)
            with asker_at(router) as asker:
                replies = {reply.key: reply for reply in await ask_all(asker, "mocap/*/parameters")}
                assert replies["mocap/lab/parameters"].payload == first.xml
                assert replies["mocap/hall/parameters"].payload == second.xml
    finally:
        middle.close()


async def test_questions_go_through_a_router() -> None:
    router, server = free_endpoint(), LabServer()
    middle = open_zenoh("router", listen=router)
    try:
        async with (
            ScriptedServer(server.script) as listening,
            gateway_at(listening.port, router=router) as gateway,
        ):
            await is_filled(gateway, server)
            await wait_until_async(lambda: gateway.sources[0].fan_out.newest)
            with asker_at(router) as asker:
                assert (await ask(asker, "mocap/lab/parameters")).payload == server.xml
                fresh = await ask(asker, "mocap/lab/parameters/3d?fresh=true;format=json")
                assert fresh.json["markers"][0]["label"] == "marker 1"
                assert (await ask(asker, "mocap/*/3d?format=json")).json["frame_number"] == 7
                assert (await ask(asker, "mocap/lab/markers")).code == "bad-request"
                assert (await ask(asker, "mocap/lab/schema/marker_t")).payload
    finally:
        middle.close()
