"""Queries of programs on Zenoh and LCM to a whole gateway, with and without a server."""

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import rtc3d
import zenoh

from gateway.config.settings import StreamSettings
from gateway.gateway import Gateway
from gateway.messages.decode import to_json
from gateway.outputs.contract import Answer, KeyPath, ServerParameters
from gateway.outputs.zenoh import queries as zenoh_queries
from gateway.outputs.zenoh.queries import ZenohQueries
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.queries.questions import SCHEMA_TYPES
from gateway.queries.service import SourceQueryService
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.integration.lcm_peer import LcmPeer
from tests.networks import free_endpoint, free_port, lcm_url, open_zenoh
from tests.queried_gateway import (
    ParameterServer,
    ServerOfSections,
    gateway_with_server,
    gateway_without_server,
    output_queries,
    query,
    query_all,
    run_gateway,
    wait_until_cached,
    zenoh_peer,
)
from tests.servers import ScriptedServer, c3d_file, markers_frame, packet
from tests.spec_parameters import BY_SECTION, spec_xml
from tests.waiting import wait_until_async

# Parameters ----------------------------------------------------------------------------------


async def test_on_zenoh_parameters_are_the_servers_xml_or_json() -> None:
    """The examples of force and events in the specification are not well-formed."""
    async with gateway_with_server(ServerOfSections()) as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/parameters?_anyke;_time=[now(-1s)..]")  # Zenoh's own options
        assert (reply.key, reply.payload) == ("mocap/lab/parameters", server.xml)
        assert (reply.encoding, reply.attachment["session"]) == ("application/xml", 1)
        assert 0 <= reply.attachment["age_s"] < 60
        assert "stale" not in reply.attachment
        for section in SECTIONS:
            assert (await query(peer, f"mocap/lab/parameters/{section}")).payload == spec_xml(section)
            reply = await query(peer, f"mocap/lab/parameters/{section}?format=json")
            [expected] = [value for value in to_json(BY_SECTION[section]).values() if value is not None]
            assert (reply.encoding, reply.json) == ("application/json", expected)
            assert bool(reply.attachment["recovered"]) == (section in {"force", "events"})


@pytest.mark.netns
async def test_only_queries_for_fresh_parameters_reach_the_server() -> None:
    url, endpoint = lcm_url(), free_endpoint()
    server = ParameterServer()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, lcm_url=url) as gateway,
    ):
        await wait_until_cached(gateway)
        on_lcm, before = LcmPeer(url), list(server.commands)
        server.xml = server.xml.replace(b">100<", b">250<")
        with zenoh_peer(endpoint) as peer:
            parameters = (await query(peer, "mocap/lab/parameters?format=json;fresh=false")).json
            assert (list(parameters), parameters["3d"]["frequency_hz"]) == (list(SECTIONS), 100)
            assert b">100<" in (await query(peer, "mocap/lab/parameters/3d")).payload
            assert ">100<" in (await on_lcm.request(1, ["3d"])).xml
            assert server.commands == before
            fresh = await query(peer, "mocap/lab/parameters/3d?fresh=true;format=json")
            assert fresh.json["frequency_hz"] == 250
            assert ">250<" in (await on_lcm.request(2, ["3d"], fresh=True)).xml
        assert server.count("SendParameters") == 3
        on_lcm.close()


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
            assert (reply.payload, reply.attachment["stale"]) == (server.xml, True)
            assert (reply.attachment["session"], reply.attachment["age_s"] > 0) == (1, True)
            reply = await query(peer, "mocap/lab/parameters/3d?stale=ok;format=json;fresh=true")
            assert reply.json["markers"]
    finally:
        await context.__aexit__(None, None, None)


async def test_a_failure_of_the_server_or_the_connection_is_the_answer() -> None:
    lab = gateway_with_server(reply_timeout_s=0.3)
    async with lab as (server, port, _, peer):
        server.sections["3d"] = b"It is 3 o'clock."
        server.xml = b"<RT_Parameters Ver='1.00'/>"
        assert (await query(peer, "mocap/lab/parameters/3d?fresh=true")).payload == b"It is 3 o'clock."
        reply = await query(peer, "mocap/lab/parameters/3d?fresh=true;format=json")
        assert reply.code == "unreadable"
        assert "ask without format=json" in reply.error
        server.refused_commands = ("SendParameters",)
        reply = await query(peer, "mocap/lab/parameters?fresh=true")
        assert (reply.code, reply.error.partition(": ")[0]) == ("refused", "source 'lab'")
        server.refused_commands, server.ignored_commands = (), ("SendParameters",)
        reply = await query(peer, "mocap/lab/parameters?fresh=true")
        assert reply.code == "timeout"
        assert reply.error == f"source 'lab': 127.0.0.1:{port} did not answer SendParameters within 0.3 s"
        server.may_answer.clear()
        before = server.count("SendParameters")
        asked = asyncio.create_task(query(peer, "mocap/lab/parameters?fresh=true"))
        await wait_until_async(lambda: server.count("SendParameters") > before)
        assert server.client is not None
        server.client.cut()
        assert (await asked).code == "no-connection"
        server.may_answer.set()


@pytest.mark.netns
async def test_without_a_connection_every_answer_says_why() -> None:
    url, endpoint, port = lcm_url(), free_endpoint(), free_port()
    async with run_gateway(port, listen=endpoint, lcm_url=url, remote_control=True) as gateway:
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.last_error)
        reason = f"source 'lab' has no connection: refused by 127.0.0.1:{port}, tried "
        with zenoh_peer(endpoint) as peer:
            for key in ("lab/parameters", "lab/parameters?stale=ok", "lab/event", "*/3d"):
                reply = await query(peer, f"mocap/{key}")
                assert reply.encoding == "text/plain;no-connection"
                assert reply.error.startswith(reason)
                assert reply.error.endswith(" s ago; is the RT server running, and is this its port?")
            assert (await query(peer, "mocap/lab/recording?set=start")).code == "no-connection"
        on_lcm = LcmPeer(url)
        reply = await on_lcm.request()
        assert (reply.error_code, reply.xml, reply.age_s) == ("no-connection", "", 0)
        assert reply.error.startswith(reason)
        on_lcm.close()


# Frames, status and schemas ------------------------------------------------------------------


async def until_a_frame(gateway: Gateway) -> None:
    await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))


@pytest.mark.netns
async def test_the_newest_frame_is_answered_even_if_pacing_leaves_it_out() -> None:
    server, endpoint = ParameterServer(), free_endpoint()
    pace = {ComponentType.MARKERS: 0.001}
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, lcm_url=lcm_url(), max_rate_hz=pace) as gateway,
    ):
        fan_out = gateway.sources[0].fan_out
        await until_a_frame(gateway)
        with zenoh_peer(endpoint) as peer:
            first = await query(peer, "mocap/lab/3d")
            for number in range(8, 20):
                server.send(markers_frame(number, (1.0, 2.0, 3.0)))
            await wait_until_async(lambda: fan_out.frames[ComponentType.MARKERS] == 13)
            newest = rtc3d.markers_t.decode((await query(peer, "mocap/lab/3d")).payload)
        sent = {output.name: status.messages["3d"] for output, status in fan_out.outputs}
    assert first.encoding == "application/x-lcm;rtc3d.markers_t"
    assert (rtc3d.markers_t.decode(first.payload).frame_number, newest.frame_number) == (7, 19)
    # Zenoh published the first frame only. LCM published all, and has other numbers.
    assert (sent, newest.sequence) == ({"zenoh": 1, "lcm": 13}, 0)
    assert server.count("SendCurrentFrame") == 0


async def test_without_a_running_stream_the_current_frame_is_requested() -> None:
    async with gateway_with_server() as (server, _, gateway, peer):
        await until_a_frame(gateway)
        event = await query(peer, "mocap/lab/event")
        expected = "no event has arrived from source 'lab' in this session"
        assert (event.code, event.error) == ("nothing-yet", expected)
        server.has_measurement = False
        assert server.client is not None
        server.client.cut()
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.session == 2 and status.state.value == "no measurement")
        reply = await query(peer, "mocap/lab/3d")  # the frame of the earlier connection is not current
        assert (reply.code, reply.error) == ("nothing-yet", "source 'lab': no measurement runs")
        server.has_measurement = True
        message = rtc3d.markers_t.decode((await query(peer, "mocap/lab/3d")).payload)
        assert (message.frame_number, message.sequence, message.session) == (7, -1, 2)
        server.refused_commands = ("SendCurrentFrame ",)
        assert (await query(peer, "mocap/lab/3d?format=json")).json["frame_number"] == 7
        assert server.commands[-2:] == ["SendCurrentFrame 3D", "SendCurrentFrame"]


async def test_the_status_counts_the_queries_about_the_source_by_result() -> None:
    async with gateway_with_server() as (_, port, gateway, peer):
        assert (await query(peer, "mocap/lab/nowhere")).code == "bad-request"
        [output] = gateway.outputs
        await wait_until_async(lambda: output.query_results == {"lab": {"bad-request": 1}})
        gateway.sources[0].publish_status()
        reply = await query(peer, "mocap/lab/status")
        assert reply.encoding == "application/x-lcm;rtc3d.status_t"
        status = rtc3d.status_t.decode(reply.payload)
        [on_zenoh] = status.outputs
        assert [(count.name, count.count) for count in on_zenoh.queries] == [("bad-request", 1)]
        assert (status.source, status.host) == ("lab", socket.gethostname())
        assert (await query(peer, "mocap/lab/status?format=json")).json["server"] == f"127.0.0.1:{port}"


USE_SCHEMAS = """
import importlib, pathlib, sys
for folder in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    for module in [name for name in sys.modules if name.partition(".")[0] == "rtc3d"]:
        del sys.modules[module]
    sys.path[0] = str(folder)
    rtc3d = importlib.import_module("rtc3d")
    assert rtc3d.__file__.startswith(sys.path[0])
    print(folder.name, getattr(rtc3d, folder.name)._get_packed_fingerprint().hex())
    if folder.name == "markers_t":
        message = rtc3d.markers_t.decode(sys.stdin.buffer.read())
        print(message.frame_number, [(marker.x, marker.y, marker.z) for marker in message.markers])
"""


def output_with_schemas(schemas: dict[str, bytes], folder: Path, frame: bytes) -> list[str]:
    """Make types of each schema alone with lcm-gen; return what USE_SCHEMAS prints with them."""
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    for name, schema in schemas.items():
        (folder / name).mkdir()
        file = folder / name / "schema.lcm"
        file.write_bytes(schema)
        subprocess.run([lcm_gen, "--python", "--ppath", file.parent, file], check=True)
    command = [sys.executable, "-c", USE_SCHEMAS, str(folder)]
    process = subprocess.run(command, env={}, input=frame, capture_output=True, check=True)
    return process.stdout.decode().splitlines()


async def test_a_decoder_made_from_a_queried_schema_alone_reads_a_queried_frame(tmp_path: Path) -> None:
    async with gateway_with_server() as (_, _, gateway, peer):
        await until_a_frame(gateway)
        frame = await query(peer, "mocap/lab/3d")
        replies = {name: await query(peer, f"mocap/lab/schema/{name}") for name in SCHEMA_TYPES}
    assert {reply.encoding for reply in replies.values()} == {"text/plain"}
    schemas = {name: reply.payload for name, reply in replies.items()}
    lines = await asyncio.to_thread(output_with_schemas, schemas, tmp_path, frame.payload)
    assert sorted(lines) == sorted(
        [f"{name} {getattr(rtc3d, name)._get_packed_fingerprint().hex()}" for name in SCHEMA_TYPES]
        + ["7 [(1.0, 2.0, 3.0)]"]
    )


# Files and recordings ------------------------------------------------------------------------


async def test_a_c3d_file_is_stored_announced_and_answered(tmp_path: Path) -> None:
    content, second = c3d_file(bytes(range(256)) * 1000, 300_000), c3d_file(b"the second")
    async with gateway_with_server(spool=tmp_path) as (server, _, _, peer):
        assert (await query(peer, "mocap/lab/c3d")).code == "nothing-yet"
        announced: list[zenoh.Sample] = []
        peer.declare_subscriber("mocap/lab/c3d", announced.append)
        await query(peer, "mocap/lab/status")  # its reply arrives after the subscription is active
        server.send(packet(5, content))
        await wait_until_async(lambda: announced)
        assert str(announced[0].encoding) == "application/json"
        description = json.loads(announced[0].payload.to_bytes())
        reply = await query(peer, "mocap/lab/c3d")
        assert (reply.payload, reply.attachment) == (content, description)
        assert (tmp_path / description["name"]).read_bytes() == content
        server.send(packet(5, second))
        await wait_until_async(lambda: len(announced) == 2)
        assert (await query(peer, "mocap/*/c3d")).payload == second


async def test_recording_control_is_off_by_default_and_the_error_says_how_to_switch_it_on() -> None:
    async with gateway_with_server() as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/recording?set=start")
        assert reply.code == "refused"
        assert "remote control is off for source 'lab'" in reply.error
        assert "remote_control: true" in reply.error
        await query(peer, "mocap/lab/parameters?fresh=true")
        assert server.received == []


RECORDING = "0000003c 00000003 00000001 00000030 00000005 ffffffff 0000000000000000 00000001 {} "
RECORDING += "0000000000000000 ffffffff ffffffff ffffffff"
"""A data packet with one event component of 48 bytes (30h), frame -1; {} is the id (field note 16)."""


async def test_recordings_are_started_and_stopped_for_a_single_source() -> None:
    async with gateway_with_server(remote_control=True) as (server, _, _, peer):
        assert "accepted: set=start;name=NAME, set=stop" in (await query(peer, "mocap/lab/recording")).error
        assert "accepted: start, stop" in (await query(peer, "mocap/lab/recording?set=pause")).error
        assert (await query(peer, "mocap/*/recording?set=start")).code == "bad-request"
        await query_all(peer, "mocap/**?set=start")
        await query(peer, "mocap/lab/parameters?fresh=true")
        assert server.received == []
        options = "duration=900,durationunits=seconds"
        reply = await query(peer, f"mocap/lab/recording?set=start;name=walk 1;options={options}")
        assert reply.json == {"source": "lab", "sent": "start", "name": "walk 1", "is_named": True}
        start = f"Recording Start,file=walk 1,{options}"
        assert reply.attachment == {"reply": f"OK-{start}"}
        assert (await query(peer, "mocap/lab/recording?set=stop")).json == {"source": "lab", "sent": "stop"}
        assert server.commands[-2:] == [start, "Recording Stop"]
        for change in ("start", "stop"):
            assert (await query(peer, f"mocap/lab/recording?set={change}")).json["sent"] == change
        await wait_until_async(lambda: len(server.received) == 2)
        assert server.received == [
            bytes.fromhex(RECORDING.format(event)) for event in ("00000001", "00000000")
        ]


# Selectors -----------------------------------------------------------------------------------

BAD_SELECTORS = [
    ("", ["accepted below mocap/lab/: parameters, "]),
    ("/parameters/4d", ["unknown section '4d'", *SECTIONS]),
    ("/parameters/3d/more", ["unknown key 'parameters/3d/more'", "parameters/3d", "status"]),
    ("/markers", ["unknown key 'markers'", "parameters", "3d", "recording", "schema/TYPE"]),
    ("/alive", ["unknown key 'alive'"]),
    ("/analog", ["component 'analog' is not configured for this source; accepted: 3d, event"]),
    ("/schema/tools", ["unknown type", "tools_t", "parameters_reply_t"]),
    ("/schema", ["unknown type", "markers_t"]),
    ("/parameters?format=yaml", ["format='yaml' is not accepted; accepted: xml, json"]),
    ("/parameters?fresh=yes", ["fresh='yes' is not accepted; accepted: true, false"]),
    ("/parameters?fresh", ["fresh='' is not accepted"]),
    ("/3d?fresh=true", ["unknown option 'fresh' of component; accepted: format=lcm|json"]),
    ("/c3d?format=json", ["unknown option 'format' of c3d; accepted: none"]),
    ("/parameters?a=b", ["unknown option 'a'", "format=xml|json, fresh=true|false, stale=ok"]),
    ("/*?format=yaml", ["format='yaml' is not accepted; accepted: xml, json, lcm"]),
    ("/*?a=b", ["unknown option 'a' of parameters, component, status", "format=", "stale=ok"]),
    ("/*/nonsense", ["nothing of source 'lab' matches mocap/lab/*/nonsense", "parameters/3d"]),
]


async def test_the_error_for_a_bad_query_lists_what_is_accepted() -> None:
    streams = (StreamSettings(components=(ComponentType.MARKERS, ComponentType.EVENT)),)
    async with gateway_without_server(streams=streams) as (_, peer):
        for selector, accepted in BAD_SELECTORS:
            reply = await query(peer, f"mocap/lab{selector}")
            assert reply.encoding == "text/plain;bad-request", selector
            assert [text for text in accepted if text not in reply.error] == [], selector
            assert "\n" not in reply.error


async def test_a_wildcard_is_answered_by_every_key_that_has_an_answer_but_files_and_recording(
    tmp_path: Path,
) -> None:
    async with gateway_with_server(spool=tmp_path, remote_control=True) as (server, _, gateway, peer):
        await until_a_frame(gateway)
        server.send(packet(5, c3d_file(b"a file")))
        await wait_until_async(lambda: list(tmp_path.glob("*.c3d")))
        replies = await query_all(peer, "mocap/lab/*?format=json")
        assert {reply.key for reply in replies} == {
            f"mocap/lab/{key}" for key in ("parameters", "3d", "status")
        }
        assert {reply.encoding for reply in replies} == {"application/json"}
        keys = [reply.key for reply in await query_all(peer, "mocap/**")]
        expected = ["parameters", *(f"parameters/{section}" for section in SECTIONS), "3d", "status"]
        expected += [f"schema/{name}" for name in SCHEMA_TYPES]
        assert sorted(keys) == sorted(f"mocap/lab/{key}" for key in expected)
        assert server.count("SendCurrentFrame") == 0


async def test_through_a_router_a_wildcard_for_sources_is_answered_by_every_source(router: str) -> None:
    first, second = ParameterServer("of the first"), ParameterServer("of the second")
    async with (
        ScriptedServer(first.script) as first_server,
        ScriptedServer(second.script) as second_server,
        run_gateway(first_server.port, router=router) as lab_gateway,
        run_gateway(second_server.port, router=router, name="hall") as hall_gateway,
    ):
        await wait_until_cached(lab_gateway)
        await wait_until_cached(hall_gateway)
        with zenoh_peer(router) as peer:
            replies = {reply.key: reply.payload for reply in await query_all(peer, "mocap/*/parameters")}
            assert replies == {"mocap/lab/parameters": first.xml, "mocap/hall/parameters": second.xml}
            assert (await query(peer, "mocap/lab/markers")).code == "bad-request"


# Limits and failures -------------------------------------------------------------------------


async def test_queries_beyond_the_limit_are_refused_as_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_queries, "MAX_PENDING", 2)
    async with gateway_with_server() as (server, _, gateway, peer):
        queries = output_queries(gateway)
        server.may_answer.clear()
        waiting = [asyncio.create_task(query(peer, "mocap/lab/parameters?fresh=true")) for _ in range(2)]
        await wait_until_async(lambda: queries._admission.num_pending == 2)
        reply = await query(peer, "mocap/lab/status")
        assert (reply.code, reply.error) == ("busy", "the gateway has too many queries; try again")
        server.may_answer.set()
        assert {reply.payload for reply in await asyncio.gather(*waiting)} == {server.xml}
        assert (await query(peer, "mocap/lab/status")).payload
        # A reply can arrive before it is counted.
        await wait_until_async(lambda: queries.results == {"lab": {"busy": 1, "ok": 3}})


class SilentService(SourceQueryService):
    """Serves the source "lab" and never answers."""

    def __init__(self) -> None:
        self.received_query = asyncio.Event()

    def serves(self, source: str) -> bool:
        return source == "lab"

    async def answer(self, _source: str, _path: KeyPath, _options: Mapping[str, str]) -> Answer:
        self.received_query.set()
        never: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        return await never


async def test_when_zenoh_closes_queries_end_at_once_and_nothing_is_published(router: str) -> None:
    service, loop = SilentService(), asyncio.get_running_loop()
    queries = ZenohQueries(ZenohSettings(), service, loop)
    session = open_zenoh("client", connect=router)
    queries.open(session, ["lab"])
    with zenoh_peer(router) as peer:
        ended = asyncio.Event()
        replies: list[zenoh.Reply] = []
        end = zenoh.handlers.Callback(replies.append, drop=lambda: loop.call_soon_threadsafe(ended.set))
        peer.get("mocap/lab/status", end, timeout=60)
        await service.received_query.wait()
        await queries.close()
        async with asyncio.timeout(120):
            await ended.wait()
        assert replies == []
    session.close()
    queries.publish_parameters("lab", ServerParameters(b"<RT_Parameters/>", 3, 2))
    queries.announce_file("lab", {"name": "a.c3d"})
