"""What the gateway adds to a client's connection: the first command, control of recordings, files."""

import asyncio
import socket
from pathlib import Path

import pytest

from gateway.errors import QueryError
from gateway.outputs.adapters.rtc3d.client_filter import (
    FILE,
    MAX_HELD_PACKETS,
    SLOW_CLIENT,
    asks_for_parameters,
    recording_control,
)
from gateway.rtc3d.commands import ControlRecording
from gateway.rtc3d.packets import Packet
from gateway.session.server.client_connection import ClientConnection
from gateway.session.server.client_session import MAX_FRAME_REQUESTS
from tests.support.statuses import amounts
from tests.support.vectors import START_RECORDING, STOP_RECORDING
from tests.unit.outputs.adapters.rtc3d.scripted_server import Client, Line, ScriptedServer, settle, write_file
from tests.unit.outputs.adapters.rtc3d.test_live_server import NO_FRAMES, STREAM, streaming
from tests.unit.session.server.wire import COMMAND, DATA, ERROR, command, packet

C3D = 5
VERSION = (COMMAND, b"OK-Version 1.0")
_CHUNK = 256 * 1024


async def test_a_client_without_a_command_is_disconnected_after_ten_seconds(server: ScriptedServer) -> None:
    """Programs of other protocols must not occupy places; errors are no commands."""
    good, wrong, silent = await server.greeted(), server.client(), server.client()
    assert [kind for kind, _ in await wrong.ask("Fly", "Fly higher")] == [ERROR, ERROR]
    await asyncio.sleep(9.9)
    assert silent.receive() == []
    await asyncio.sleep(0.1)
    for client in (wrong, silent):
        assert client.receive() == [(ERROR, b"Error-No command within 10 s; closing")]
        assert client.line.is_closed
    assert good.receive() == []
    assert not good.line.is_closed


async def test_the_system_is_asked_to_notice_vanished_clients() -> None:
    """A computer that loses power sends no end."""
    options = ScriptedServer().client().line.options
    assert options[socket.SO_KEEPALIVE] == 1
    idle, interval, count = socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT
    assert (options[idle], options[interval], options[count]) == (10, 5, 3)
    assert options[socket.TCP_USER_TIMEOUT] == 300_000


# Recordings ---------------------------------------------------------------------------------


async def test_a_recording_is_acknowledged_once_it_is_done(server: ScriptedServer, client: Client) -> None:
    """Commands after it wait, so that a client sees the replies in order. It gets those of the server."""
    options = ", File=take1.tsv,duration=5,durationunits=seconds"
    assert await client.ask(f"recording Start{options}", "Recording Stop", "Version 1.0") == []
    assert server.asked == [("lab", True, options)]
    await server.answers.put("ok file=take1_002.tsv\xe9")
    await settle()
    assert client.receive() == [(COMMAND, b"ok file=take1_002.tsv\xe9")]
    assert server.asked[1:] == [("lab", False, "")]
    await server.answers.put("")
    await settle()
    assert client.receive() == [(COMMAND, b"OK-Recording Stop"), VERSION]
    await asyncio.sleep(20)
    assert not client.line.is_closed  # the control of a recording was its first command


@pytest.mark.parametrize(("sent", "done"), [("Recording Start", b"started"), ("Recording Stop", b"stopped")])
async def test_a_refusal_says_why(server: ScriptedServer, client: Client, sent: str, done: bytes) -> None:
    """A defect is no reason to leave the client without an answer; it waits for 30 s at most."""
    for error, text in (
        (QueryError("off"), b"Error-The recording was not " + done + b": off"),
        (KeyError(), b"Error-No answer because of a defect in the gateway"),
    ):
        await server.answers.put(error)
        assert await client.ask(sent) == [(ERROR, text)]
        assert await client.ask("Version 1.0") == [VERSION]
    assert await client.ask(sent) == []
    await asyncio.sleep(29.9)
    assert client.receive() == []
    await asyncio.sleep(0.2)
    assert client.receive() == [(ERROR, b"Error-The recording was not " + done + b": no answer within 30 s")]


async def test_a_client_that_goes_ends_what_waits_for_it(client: Client) -> None:
    """Nothing is left behind: no timer, no task."""
    await client.ask("Recording Start")
    client.line.abort()
    await settle()
    assert asyncio.all_tasks() == {asyncio.current_task()}
    await asyncio.sleep(20)
    assert client.receive() == []


@pytest.mark.parametrize("sent", [["Recording Start", "Recording Stop"], ["Recording Stop"]])
async def test_a_stop_is_carried_out_although_its_client_has_gone(
    server: ScriptedServer, client: Client, sent: list[str]
) -> None:
    """Also if it waits for the start before it. Otherwise the server would record until its disk is full."""
    await client.ask(*sent)
    client.line.abort()
    await settle()
    assert server.asked[-1] == ("lab", False, "")
    await server.answers.put("")
    await settle()
    assert server.answers.empty()  # it was not cancelled
    assert asyncio.all_tasks() == {asyncio.current_task()}


# Files --------------------------------------------------------------------------------------


async def stalled(server: ScriptedServer, tmp_path: Path, content: bytes = b"walk", *texts: str) -> Client:
    """Return a client that does not read, with a file on the way to it."""
    client = await server.greeted(*texts)
    client.receive()
    client.line.num_unread = 2**30
    server.send_file(write_file(tmp_path, "walk.c3d", content))
    await settle()
    return client


async def test_files_go_whole_and_in_order_to_clients_that_have_greeted(tmp_path: Path) -> None:
    """A half-open connection gets no file, and files are closed."""
    server = ScriptedServer()
    client, silent = await server.greeted(), server.client()
    contents = [bytes([number]) * length for number, length in enumerate((3 * _CHUNK + 7, 1, _CHUNK, 0))]
    for number, content in enumerate(contents):
        server.send_file(write_file(tmp_path, f"{number}.c3d", content))
    await settle()
    assert client.receive() == [(C3D, content) for content in contents]
    assert silent.receive() == []
    assert server.files.opened == []
    assert not server.losses.report()


async def test_a_file_is_read_no_faster_than_the_client_reads(server: ScriptedServer, tmp_path: Path) -> None:
    """A long file must not fill the memory."""
    content = bytes(5 * _CHUNK)
    client = await stalled(server, tmp_path, content)
    client.line.num_unread = 1024 * 1024 + 1
    await asyncio.sleep(10)
    assert len(client.line.written) == 8 + _CHUNK
    client.line.num_unread = 1024 * 1024
    await asyncio.sleep(0.1)
    assert client.receive() == [(C3D, content)]


async def test_at_most_four_files_wait_for_a_client(server: ScriptedServer, tmp_path: Path) -> None:
    """Further ones are counted as lost."""
    await server.greeted()
    for number in range(6):
        server.send_file(write_file(tmp_path, f"{number}.c3d", b"x"))
    assert amounts(server.losses.report()) == {FILE: (2, 0)}


async def test_a_file_that_is_gone_is_counted_and_the_next_one_comes(tmp_path: Path) -> None:
    """The client stays connected: it has got nothing of it."""
    server = ScriptedServer()
    client = await server.greeted()
    server.send_file(tmp_path / "gone.c3d")
    server.send_file(write_file(tmp_path, "walk.c3d", b"walk"))
    await settle()
    assert client.receive() == [(C3D, b"walk")]
    assert amounts(server.losses.report()) == {FILE: (1, 0)}


async def test_a_file_that_became_shorter_ends_the_connection(server: ScriptedServer, tmp_path: Path) -> None:
    """The client expects the rest, and would take further packets for it."""
    client = await stalled(server, tmp_path, bytes(2 * _CHUNK))
    write_file(tmp_path, "walk.c3d", b"short")
    client.line.num_unread = 0
    await asyncio.sleep(0.1)
    assert client.line.is_aborted
    assert amounts(server.losses.report()) == {FILE: (1, 0)}
    assert server.files.opened == []


async def test_replies_wait_for_the_end_of_a_file_and_frames_are_dropped(tmp_path: Path) -> None:
    """Nothing may come in the middle of a file, and nothing twice."""
    server = ScriptedServer()
    client = await streaming(server)
    client.line.num_unread = 2**30
    server.send_file(write_file(tmp_path, "walk.c3d", b"walk"))
    await settle()
    client.connection.filter.receive(command("Version 1.0"))
    server.arrive(2)
    server.state.is_streaming = False
    await asyncio.sleep(1)
    server.apply_state()
    client.line.num_unread = 0
    await asyncio.sleep(0.1)
    assert client.receive() == [(C3D, b"walk"), NO_FRAMES, VERSION]
    server.send_file(write_file(tmp_path, "run.c3d", b"run"))
    await settle()
    assert client.receive() == [(C3D, b"run")]
    server.arrive(3)
    await settle()
    assert [kind for kind, _ in client.receive()] == [DATA]
    assert client.connection.session.frames_dropped == 1


async def test_packets_held_back_by_a_file_are_bounded(server: ScriptedServer, tmp_path: Path) -> None:
    """Exactly as many wait as fit; the others are counted."""
    client = await stalled(server, tmp_path, b"walk", STREAM)
    for _ in range(MAX_HELD_PACKETS + 3):
        client.connection.filter.send(packet(*NO_FRAMES))
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (3, 0)}
    client.line.num_unread = 0
    await asyncio.sleep(0.1)
    assert client.receive() == [(C3D, b"walk"), *[NO_FRAMES] * MAX_HELD_PACKETS]
    assert MAX_HELD_PACKETS > MAX_FRAME_REQUESTS


# Which packets control recordings ----------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "control"),
    [
        (Packet(COMMAND, b"Recording Start,file=walk 1.c3d\n"), ControlRecording(True, ",file=walk 1.c3d")),
        (Packet(COMMAND, b"recording stop\0"), ControlRecording(False)),
        *((Packet(COMMAND, text), None) for text in (b"Version 1.0", b"Recording", b"")),
        (Packet(DATA, START_RECORDING[8:]), ControlRecording(True)),
        (Packet(DATA, STOP_RECORDING[8:]), ControlRecording(False)),
        *((Packet(DATA, data), None) for data in (b"\0\0\0\1", b"\0\0\0\0")),
        (Packet(77, START_RECORDING[8:]), None),
    ],
)
def test_only_recording_commands_start_and_stop(sent: Packet, control: ControlRecording | None) -> None:
    assert recording_control(sent) == control


def test_requests_for_parameters_are_recognised() -> None:
    assert asks_for_parameters(Packet(COMMAND, b"sendparameters 3D\n"))
    for other in (
        Packet(COMMAND, b"SendCurrentFrame"),
        Packet(COMMAND, b""),
        Packet(DATA, b"SendParameters"),
    ):
        assert not asks_for_parameters(other)


async def test_a_client_that_resets_its_connection_at_once_is_no_defect(server: ScriptedServer) -> None:
    """The system no longer knows its address; a port scan must not look like a problem of the source."""
    line = Line(None)
    connection = line.protocol = ClientConnection(server)
    connection.connection_made(line)
    connection.connection_lost(ConnectionResetError())
    assert not server.connections
