"""What the gateway adds to a client's connection: the first command, control of recordings, files."""

import asyncio
import socket
from pathlib import Path

import pytest

from gateway.errors import QueryError
from gateway.outputs.rtc3d.client_filter import MAX_HELD_PACKETS
from gateway.outputs.rtc3d.live_server import FILE, SLOW_CLIENT
from gateway.rtc3d_server.client_session import MAX_FRAME_REQUESTS
from tests.losses import amounts
from tests.unit.outputs.rtc3d.scripted_server import (
    Client,
    ScriptedServer,
    in_virtual_time,
    settle,
    write_file,
)
from tests.unit.outputs.rtc3d.test_live_server import NO_FRAMES, STREAM, streaming
from tests.unit.rtc3d_server.wire import COMMAND, DATA, ERROR, command, packet

C3D = 5
VERSION = (COMMAND, b"OK-Version 1.0")
_CHUNK = 256 * 1024


@in_virtual_time
async def test_a_client_without_a_command_is_disconnected_after_ten_seconds() -> None:
    """Programs of other protocols must not occupy places; errors are no commands."""
    server = ScriptedServer()
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


@in_virtual_time
async def test_the_system_is_asked_to_notice_vanished_clients() -> None:
    """A computer that loses power sends no end."""
    options = ScriptedServer().client().line.options
    assert options[socket.SO_KEEPALIVE] == 1
    assert (options[socket.TCP_KEEPIDLE], options[socket.TCP_KEEPINTVL], options[socket.TCP_KEEPCNT]) == (
        10,
        5,
        3,
    )
    assert options[socket.TCP_USER_TIMEOUT] == 300_000


# Recordings ---------------------------------------------------------------------------------


@in_virtual_time
async def test_a_recording_is_acknowledged_once_the_server_has_done_it() -> None:
    """Commands after it wait, so that a client sees the replies in order."""
    server = ScriptedServer()
    client = server.client()
    start, stop = "Recording Start,file=walk.c3d", "Recording Stop"
    assert await client.ask(start, stop, "Version 1.0") == []
    assert server.asked == [("lab", True, "walk")]
    await server.answers.put(None)
    await settle()
    assert client.receive() == [(COMMAND, f"OK-{start}".encode())]
    assert server.asked[1:] == [("lab", False, "")]
    await server.answers.put(None)
    await settle()
    assert client.receive() == [(COMMAND, b"OK-Recording Stop"), VERSION]
    await asyncio.sleep(20)
    assert not client.line.is_closed  # the control of a recording was its first command


@pytest.mark.parametrize(("sent", "done"), [("Recording Start", b"started"), ("Recording Stop", b"stopped")])
@pytest.mark.parametrize(
    ("error", "reason"),
    [(QueryError("remote control is off"), b"remote control is off"), (KeyError(), b"a defect")],
)
@in_virtual_time
async def test_why_a_recording_was_not_made_is_said(
    sent: str, done: bytes, error: Exception, reason: bytes
) -> None:
    """A defect is no reason to leave the client without an answer."""
    server = ScriptedServer()
    client = server.client()
    await server.answers.put(error)
    [(kind, text)] = await client.ask(sent)
    assert kind == ERROR
    assert text.startswith(b"Error-The recording was not " + done + b": " + reason)
    assert await client.ask("Version 1.0") == [VERSION]


@in_virtual_time
async def test_a_recording_that_is_not_answered_is_an_error_after_30_s() -> None:
    """The client can go on."""
    server = ScriptedServer()
    client = server.client()
    assert await client.ask("Recording Start") == []
    await asyncio.sleep(29.9)
    assert client.receive() == []
    await asyncio.sleep(0.2)
    assert client.receive() == [(ERROR, b"Error-The recording was not started: no answer within 30 s")]


@in_virtual_time
async def test_a_client_that_goes_ends_what_waits_for_it() -> None:
    """Nothing is left behind: no timer, no task."""
    server = ScriptedServer()
    client = server.client()
    await client.ask("Recording Start")
    client.line.abort()
    await settle()
    assert asyncio.all_tasks() == {asyncio.current_task()}
    await asyncio.sleep(20)
    assert client.receive() == []


# Files --------------------------------------------------------------------------------------


async def started(server: ScriptedServer, *texts: str) -> Client:
    client = await server.greeted(*texts)
    client.receive()
    return client


@in_virtual_time
async def test_files_go_whole_and_in_order_to_clients_that_have_greeted(tmp_path: Path) -> None:
    """A half-open connection gets no file, and files are closed."""
    server = ScriptedServer()
    client, silent = await started(server), server.client()
    contents = [bytes([number]) * length for number, length in enumerate((3 * _CHUNK + 7, 1, _CHUNK, 0))]
    for number, content in enumerate(contents):
        server.send_file(write_file(tmp_path, f"{number}.c3d", content))
    await settle()
    assert client.receive() == [(C3D, content) for content in contents]
    assert silent.receive() == []
    assert server.files.opened == []
    assert not server.losses.report()


@in_virtual_time
async def test_a_file_is_read_no_faster_than_the_client_reads(tmp_path: Path) -> None:
    """A long file must not fill the memory."""
    server = ScriptedServer()
    client = await started(server)
    content = bytes(5 * _CHUNK)
    client.line.num_unread = 1024 * 1024 + 1
    server.send_file(write_file(tmp_path, "walk.c3d", content))
    await asyncio.sleep(10)
    assert len(client.line.written) == 8 + _CHUNK
    client.line.num_unread = 1024 * 1024
    await asyncio.sleep(0.1)
    assert client.receive() == [(C3D, content)]


@in_virtual_time
async def test_at_most_four_files_wait_for_a_client(tmp_path: Path) -> None:
    """Further ones are counted as lost."""
    server = ScriptedServer()
    await started(server)
    for number in range(6):
        server.send_file(write_file(tmp_path, f"{number}.c3d", b"x"))
    assert amounts(server.losses.report()) == {FILE: (2, 0)}


@in_virtual_time
async def test_a_file_that_is_gone_is_counted_and_the_next_one_comes(tmp_path: Path) -> None:
    """The client stays connected: it has got nothing of it."""
    server = ScriptedServer()
    client = await started(server)
    server.send_file(tmp_path / "gone.c3d")
    server.send_file(write_file(tmp_path, "walk.c3d", b"walk"))
    await settle()
    assert client.receive() == [(C3D, b"walk")]
    assert amounts(server.losses.report()) == {FILE: (1, 0)}


@in_virtual_time
async def test_a_file_that_became_shorter_ends_the_connection(tmp_path: Path) -> None:
    """The client expects the rest, and would take further packets for it."""
    server = ScriptedServer()
    client = await started(server)
    path = write_file(tmp_path, "walk.c3d", bytes(2 * _CHUNK))
    client.line.num_unread = 2**30
    server.send_file(path)
    await settle()
    path.write_bytes(b"short")
    client.line.num_unread = 0
    await asyncio.sleep(0.1)
    assert client.line.is_aborted
    assert amounts(server.losses.report()) == {FILE: (1, 0)}
    assert server.files.opened == []


@in_virtual_time
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


@in_virtual_time
async def test_packets_that_wait_for_the_end_of_a_file_are_bounded(tmp_path: Path) -> None:
    """Exactly as many wait as fit; the others are counted."""
    server = ScriptedServer()
    client = await started(server, STREAM)
    client.line.num_unread = 2**30
    server.send_file(write_file(tmp_path, "walk.c3d", b"walk"))
    await settle()
    for _ in range(MAX_HELD_PACKETS + 3):
        client.connection.filter.send(packet(*NO_FRAMES))
    assert amounts(server.losses.report()) == {SLOW_CLIENT: (3, 0)}
    client.line.num_unread = 0
    await asyncio.sleep(0.1)
    assert client.receive() == [(C3D, b"walk"), *[NO_FRAMES] * MAX_HELD_PACKETS]
    assert MAX_HELD_PACKETS > MAX_FRAME_REQUESTS
