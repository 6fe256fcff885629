"""Queries for frames, status, schemas, files and recording over real Zenoh sessions."""

import asyncio
import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import rtc3d
import zenoh

from gateway.queries.questions import SCHEMA_TYPES
from gateway.rtc3d.components import ComponentType
from tests.networks import free_endpoint, lcm_url
from tests.queried_gateway import (
    ParameterServer,
    gateway_with_server,
    gateway_without_server,
    query,
    query_all,
    run_gateway,
    zenoh_peer,
)
from tests.servers import ScriptedServer, c3d_file, markers_frame, packet
from tests.waiting import wait_until_async


async def test_a_streaming_component_is_answered_with_its_newest_message() -> None:
    async with gateway_with_server() as (server, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        reply = await query(peer, "mocap/lab/3d")
        assert reply.payload == gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh")
        assert reply.encoding == "application/x-lcm;rtc3d.markers_t"
        message = rtc3d.markers_t.decode(reply.payload)
        assert (message.frame_number, message.num_markers) == (7, 1)
        assert message.sequence == 0
        assert server.count("SendCurrentFrame") == 0


@pytest.mark.netns
async def test_the_newest_frame_is_answered_even_if_pacing_leaves_it_out() -> None:
    server, endpoint = ParameterServer(), free_endpoint()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(
            listening.port,
            listen=endpoint,
            lcm_url=lcm_url(),
            max_rate_hz={ComponentType.MARKERS: 0.001},
        ) as gateway,
    ):
        fan_out = gateway.sources[0].fan_out
        await wait_until_async(lambda: fan_out.newest(ComponentType.MARKERS, "zenoh"))
        for number in range(8, 20):
            server.send(markers_frame(number, (1.0, 2.0, 3.0)))
        await wait_until_async(lambda: fan_out.frames[ComponentType.MARKERS] == 13)
        with zenoh_peer(endpoint) as peer:
            message = rtc3d.markers_t.decode((await query(peer, "mocap/lab/3d")).payload)
        sent = {output.name: status.messages["3d"] for output, status in fan_out.outputs}
    # Zenoh published the first frame only. LCM published all, and has other numbers.
    assert sent == {"zenoh": 1, "lcm": 13}
    assert (message.frame_number, message.sequence) == (19, 0)


async def test_without_a_running_stream_the_current_frame_is_requested() -> None:
    server = ParameterServer()
    server.has_measurement = False
    async with gateway_with_server(server) as (_, _, _, peer):
        server.has_measurement = True
        message = rtc3d.markers_t.decode((await query(peer, "mocap/lab/3d")).payload)
        assert (message.frame_number, message.sequence, message.session) == (7, -1, 1)
        assert server.commands[-1] == "SendCurrentFrame 3D"


async def test_a_server_that_refuses_component_names_is_asked_for_the_whole_frame() -> None:
    server = ParameterServer()
    server.has_measurement = False
    server.refused_commands = ("SendCurrentFrame ",)
    async with gateway_with_server(server) as (_, _, _, peer):
        server.has_measurement = True
        assert (await query(peer, "mocap/lab/3d?format=json")).json["frame_number"] == 7
        assert server.commands[-2:] == ["SendCurrentFrame 3D", "SendCurrentFrame"]


async def test_without_a_measurement_there_is_no_current_frame() -> None:
    server = ParameterServer()
    server.has_measurement = False
    async with gateway_with_server(server) as (_, _, _, peer):
        reply = await query(peer, "mocap/lab/3d")
        assert (reply.code, reply.error) == ("nothing-yet", "source 'lab': no measurement runs")


async def test_a_component_that_has_not_arrived_is_an_error() -> None:
    async with gateway_with_server() as (_, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        reply = await query(peer, "mocap/lab/event")
        assert reply.code == "nothing-yet"
        assert reply.error == "no event has arrived from source 'lab' in this session"


async def test_frames_of_an_earlier_connection_are_not_current() -> None:
    async with gateway_with_server() as (server, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        server.has_measurement = False
        assert server.client is not None
        server.client.cut()
        [status] = gateway.sources[0].statuses
        await wait_until_async(lambda: status.session == 2 and status.state.value == "no measurement")
        assert (await query(peer, "mocap/lab/3d")).error == "source 'lab': no measurement runs"


async def test_a_current_frame_without_the_component_is_an_error() -> None:
    server = ParameterServer()
    server.has_measurement = False
    async with gateway_with_server(server) as (_, _, _, peer):
        server.ignored_commands = ("SendCurrentFrame",)
        reply_task = asyncio.create_task(query(peer, "mocap/lab/3d"))
        await wait_until_async(lambda: server.count("SendCurrentFrame"))
        server.send(packet(3, b"\0\0\0\0"))  # a frame without components
        reply = await reply_task
        assert (reply.code, reply.error) == ("nothing-yet", "the current frame has no 3d")


async def test_the_status_is_answered_as_message_or_as_json() -> None:
    async with gateway_with_server() as (_, port, _, peer):
        reply = await query(peer, "mocap/lab/status")
        assert reply.encoding == "application/x-lcm;rtc3d.status_t"
        assert rtc3d.status_t.decode(reply.payload).source == "lab"
        assert (await query(peer, "mocap/lab/status?format=json")).json["server"] == f"127.0.0.1:{port}"


async def test_the_status_counts_the_queries_about_the_source_by_result() -> None:
    async with gateway_with_server() as (_, _, gateway, peer):
        assert (await query(peer, "mocap/lab/nowhere")).code == "bad-request"
        [output] = gateway.outputs
        await wait_until_async(lambda: output.query_results == {"lab": {"bad-request": 1}})
        gateway.sources[0].publish_status()
        status = rtc3d.status_t.decode((await query(peer, "mocap/lab/status")).payload)
        [zenoh] = status.outputs
        assert [(count.name, count.count) for count in zenoh.queries] == [("bad-request", 1)]
        assert status.host == socket.gethostname()


def run_with_types_of(schema: bytes, folder: Path, code: str, stdin: bytes = b"") -> list[str]:
    """Generate types from a schema with lcm-gen, run ``code`` with them, and return the words it prints."""
    (folder / "schema.lcm").write_bytes(schema)
    lcm_gen = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([lcm_gen, "--python", "--ppath", folder, folder / "schema.lcm"], check=True)
    command, environment = [sys.executable, "-c", f"import rtc3d; {code}"], {"PYTHONPATH": str(folder)}
    process = subprocess.run(command, env=environment, input=stdin, capture_output=True, check=True)
    return process.stdout.decode().split()


@pytest.mark.parametrize("name", SCHEMA_TYPES)
async def test_lcm_gen_makes_a_decoder_from_a_schema_alone(name: str, tmp_path: Path) -> None:
    async with gateway_without_server() as (_, peer):
        schema = await query(peer, f"mocap/lab/schema/{name}")
        assert schema.encoding == "text/plain"
    code = f"print(rtc3d.__file__, rtc3d.{name}._get_packed_fingerprint().hex())"
    where, fingerprint = await asyncio.to_thread(run_with_types_of, schema.payload, tmp_path, code)
    assert where.startswith(str(tmp_path))
    assert fingerprint == getattr(rtc3d, name)._get_packed_fingerprint().hex()


async def test_a_decoder_from_a_queried_schema_reads_a_queried_frame(tmp_path: Path) -> None:
    async with gateway_with_server() as (_, _, gateway, peer):
        await wait_until_async(lambda: gateway.sources[0].fan_out.newest(ComponentType.MARKERS, "zenoh"))
        frame = await query(peer, "mocap/lab/3d")
        schema = await query(peer, f"mocap/lab/schema/{frame.encoding.partition(';')[2]}")
    code = (
        "import sys; message = rtc3d.markers_t.decode(sys.stdin.buffer.read());"
        "print(message.frame_number, *((marker.x, marker.y, marker.z) for marker in message.markers))"
    )
    words = await asyncio.to_thread(run_with_types_of, schema.payload, tmp_path, code, frame.payload)
    assert words == ["7", "(1.0,", "2.0,", "3.0)"]


async def test_a_c3d_file_is_stored_announced_and_answered(tmp_path: Path) -> None:
    content, second = c3d_file(bytes(range(256)) * 1000, 300_000), c3d_file(b"the second")
    async with gateway_with_server(spool=tmp_path) as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/c3d")
        assert (reply.code, reply.error) == ("nothing-yet", "source 'lab' has sent no C3D file so far")
        announced: list[zenoh.Sample] = []
        peer.declare_subscriber("mocap/lab/c3d", announced.append)
        await query(peer, "mocap/lab/status")  # its reply arrives after the subscription is active
        server.send(packet(5, content))
        await wait_until_async(lambda: announced)
        assert str(announced[0].encoding) == "application/json"
        description = json.loads(announced[0].payload.to_bytes())
        assert description["bytes"] == len(content)
        reply = await query(peer, "mocap/lab/c3d")
        assert reply.payload == content
        assert reply.attachment == description
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


async def test_recording_is_started_and_stopped_with_the_packet_of_wavefront() -> None:
    async with gateway_with_server(remote_control=True) as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/recording?set=start")
        assert reply.json == {"source": "lab", "sent": "start"}
        reply = await query(peer, "mocap/lab/recording?set=stop")
        assert reply.json == {"source": "lab", "sent": "stop"}
        await wait_until_async(lambda: len(server.received) == 2)
        start, stop = (bytes.fromhex(RECORDING.format(event)) for event in ("00000001", "00000000"))
        assert server.received == [start, stop]


async def test_a_recording_with_a_name_is_started_and_stopped_with_commands() -> None:
    async with gateway_with_server(remote_control=True) as (server, _, _, peer):
        reply = await query(peer, "mocap/lab/recording?set=start;name=walk 1")
        assert reply.json == {"source": "lab", "sent": "start", "name": "walk 1", "is_named": True}
        reply = await query(peer, "mocap/lab/recording?set=stop")
        assert reply.json == {"source": "lab", "sent": "stop"}
        assert server.commands[-2:] == ["Recording Start,file=walk 1.c3d", "Recording Stop"]
        assert server.received == []


async def test_recording_control_needs_a_valid_option_and_a_single_source() -> None:
    async with gateway_with_server(remote_control=True) as (server, _, _, peer):
        assert "accepted: set=start;name=NAME, set=stop" in (await query(peer, "mocap/lab/recording")).error
        assert "accepted: start, stop" in (await query(peer, "mocap/lab/recording?set=pause")).error
        reply = await query(peer, "mocap/*/recording?set=start")
        assert (
            reply.error
            == "recording needs the name of one source, not a wildcard; accepted: mocap/lab/recording"
        )
        await query_all(peer, "mocap/**?set=start")
        await query(peer, "mocap/lab/parameters?fresh=true")
        assert server.received == []


async def test_recording_control_without_a_connection_is_an_error() -> None:
    async with gateway_without_server(remote_control=True) as (port, peer):
        reply = await query(peer, "mocap/lab/recording?set=start")
        assert reply.code == "no-connection"
        assert f"refused by 127.0.0.1:{port}" in reply.error
