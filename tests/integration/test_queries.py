"""Queries of programs on Zenoh and LCM to a whole gateway with its server."""

import asyncio
import json
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import rtc3d

from gateway.config.settings import StreamSettings
from gateway.messages.decode import decode, to_json
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import SECTIONS
from tests.support.networks import free_endpoint, lcm_url
from tests.support.parameters import BY_SECTION, in_root, spec_xml
from tests.support.queried_gateway import (
    ParameterServer,
    ServerOfSections,
    gateway_with_server,
    query,
    query_all,
    run_gateway,
    until_a_frame,
    wait_until_cached,
    wait_until_found,
    zenoh_peer,
)
from tests.support.servers import ScriptedServer, c3d_file, packet
from tests.support.waiting import wait_until_async

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


class LcmPeer:
    """A program on LCM that sends requests about the source lab, and receives all replies."""

    def __init__(self, url: str) -> None:
        self._lcm = open_lcm(url)
        self.replies: list[rtc3d.parameters_reply_t] = []
        self._subscriber = LcmSubscriber(
            self._lcm, "MOCAP_LAB_PARAMETERS_REPLY", lambda _, data: self.replies.append(decode(data))
        )

    def send(self, number: int, *sections: str, requester: str = "test", fresh: bool = False) -> None:
        message = rtc3d.parameters_request_t()
        message.request_id, message.requester, message.fresh = number, requester, fresh
        message.sections, message.num_sections = list(sections), len(sections)
        self._lcm.publish("MOCAP_LAB_PARAMETERS_REQUEST", message.encode())

    async def request(self, number: int, *sections: str, fresh: bool = False) -> bytes:
        """Send a request and return the XML of its only reply."""
        self.send(number, *sections, fresh=fresh)
        await wait_until_async(lambda: number in [reply.request_id for reply in self.replies])
        [reply] = [reply for reply in self.replies if reply.request_id == number]
        return bytes(reply.xml.encode())

    def close(self) -> None:
        self._subscriber.close()


@pytest.mark.netns
async def test_on_lcm_parameters_are_the_servers_xml() -> None:
    """Requests have a URL of their own; those on the URL for data are ignored."""
    server, url, queries_url = ServerOfSections(), lcm_url(), lcm_url()
    server.sections["3d force"] = both = in_root("<The_3D/>", "<Force/>")
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, lcm_url=url, queries_url=queries_url) as gateway,
    ):
        await wait_until_cached(gateway)
        with closing(LcmPeer(queries_url)) as peer, closing(LcmPeer(url)) as wrong_url_peer:
            wrong_url_peer.send(99)
            peer.send(-(2**63), requester="Käfig, 2")
            await wait_until_async(lambda: peer.replies)
            [reply] = peer.replies
            assert (reply.request_id, reply.requester) == (-(2**63), "Käfig, 2")
            assert (reply.xml.encode(), reply.error, reply.error_code) == (server.xml, "", "")
            assert 0 <= reply.age_s < 60
            for number, section in enumerate(SECTIONS):
                assert await peer.request(number, section) == spec_xml(section)
            assert await peer.request(10, "force", "3d", "3d") == both
            assert server.commands[-1] == "SendParameters 3D Force"
            num_requests = server.count("SendParameters")
            assert await peer.request(11, "3d", "force") == both
            assert server.count("SendParameters") == num_requests
            assert await peer.request(12, "3d", "force", fresh=True) == both
            assert server.count("SendParameters") > num_requests
            assert 99 not in [reply.request_id for reply in peer.replies]
            assert not wrong_url_peer.replies


# Frames, schemas and the coordinate frame -----------------------------------------------------


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


Y_UP = {"scale": 2.0, "up": "y", "translation_m": [10.0, 0.0, 1.0]}
HALF = 0.5**0.5
FRAME = {
    "frame_id": "world",
    "metres_per_unit": 0.002,
    "rotation_xyzw": [HALF, 0.0, 0.0, HALF],
    "translation_m": [10.0, 0.0, 1.0],
}


@pytest.mark.netns
async def test_receivers_on_zenoh_and_lcm_learn_the_frame() -> None:
    """The frame of poses is in the answers to queries, with the parameters and in the status."""
    endpoint, url = free_endpoint(), lcm_url()
    lcm: dict[str, Any] = {"lcm_url": url, "queries_url": url}
    replies: list[rtc3d.command_reply_t] = []
    async with (
        ScriptedServer(ParameterServer().script) as server,
        run_gateway(server.port, listen=endpoint, frame_id="world", transform=Y_UP, **lcm) as gateway,
    ):
        await wait_until_cached(gateway)
        with zenoh_peer(endpoint) as peer:
            reply = await query(peer, "mocap/lab/frame")
            parameters = await query(peer, "mocap/lab/parameters")
            status = decode((await query(peer, "mocap/lab/status")).payload)
        connection = open_lcm(url)
        subscriber = LcmSubscriber(
            connection, "MOCAP_LAB_COMMAND_REPLY", lambda _, message: replies.append(decode(message))
        )
        request = rtc3d.command_request_t()
        request.requester, request.command = "test", "frame"
        connection.publish("MOCAP_LAB_COMMAND_REQUEST", request.encode())
        await wait_until_async(lambda: replies)
        subscriber.close()
    expected = {**FRAME, "names": {}}
    assert (reply.json, reply.encoding) == (expected, "application/json")
    assert json.loads(replies[0].content) == expected
    assert parameters.attachment["frame"] == FRAME
    in_status = {name: getattr(status, name) for name in FRAME}
    assert in_status == {key: tuple(each) if isinstance(each, list) else each for key, each in FRAME.items()}


# Selectors -----------------------------------------------------------------------------------


BAD_SELECTORS = [
    ("", ["accepted below mocap/lab/: parameters, "]),
    ("/parameters/4d", ["unknown section '4d'", *SECTIONS]),
    ("/parameters/3d/more", ["unknown key 'parameters/3d/more'", "parameters/3d", "status"]),
    ("/markers", ["unknown key 'markers'", "parameters", "3d", "recording", "schema/TYPE"]),
    ("/alive", ["unknown key 'alive'"]),
    ("/analog", ["'analog'", "3d, event"]),
    ("/schema/tools", ["unknown type", "tools_t", "parameters_reply_t"]),
    ("/schema", ["unknown type", "markers_t"]),
    ("/parameters?format=yaml", ["format='yaml'", "xml, json"]),
    ("/parameters?fresh=yes", ["fresh='yes'", "true, false"]),
    ("/parameters?fresh", ["fresh=''", "true, false"]),
    ("/3d?fresh=true", ["'fresh'", "format=lcm|json"]),
    ("/c3d?format=json", ["'format'", "c3d"]),
    ("/parameters?a=b", ["'a'", "format=xml|json, fresh=true|false, stale=ok"]),
    ("/*?format=yaml", ["format='yaml'", "xml, json, lcm"]),
    ("/*?a=b", ["'a'", "parameters, component, status", "format=", "stale=ok"]),
    ("/*/nonsense", ["'lab'", "mocap/lab/*/nonsense", "parameters/3d"]),
]


async def test_the_error_for_a_bad_query_lists_what_is_accepted() -> None:
    streams = (StreamSettings(components=(ComponentType.MARKERS, ComponentType.EVENT)),)
    async with gateway_with_server(streams=streams) as (_, _, _, peer):
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
            f"mocap/lab/{key}" for key in ("parameters", "3d", "status", "history")
        }
        assert {reply.encoding for reply in replies} == {"application/json"}
        keys = [reply.key for reply in await query_all(peer, "mocap/**")]
        expected = ["parameters", *(f"parameters/{section}" for section in SECTIONS)]
        expected += ["3d", "status", "history"]
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
            for source in ("lab", "hall"):
                await wait_until_found(peer, source)
            replies = {reply.key: reply.payload for reply in await query_all(peer, "mocap/*/parameters")}
            assert replies == {"mocap/lab/parameters": first.xml, "mocap/hall/parameters": second.xml}
            assert (await query(peer, "mocap/lab/markers")).code == "bad-request"
