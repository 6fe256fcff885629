"""The limits of RTC3D clients of a gateway: files, slow clients, too many clients, floods."""

import logging
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.losses import Loss
from gateway.outputs.contract import ServerFile
from gateway.outputs.rtc3d import client_filter, live_frames
from gateway.outputs.rtc3d.live_server import SLOW_CLIENT
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.serving_gateway import ServingGateway, playing
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
    NO_DATA,
    command,
    components_in,
    packets_in,
)

C3D = 5


# Files --------------------------------------------------------------------------------------


async def test_a_file_of_the_server_is_passed_on_whole_between_frames(tmp_path: Path) -> None:
    content = bytes(range(256)) * 40_000  # longer than what waits in memory
    path = tmp_path / "walk.c3d"
    path.write_bytes(content)
    async with (
        playing() as (_, gateway),
        connected(gateway) as client,
        connected(gateway) as half_open,
    ):
        await client.ask("StreamFrames All")
        await client.frames(3)
        gateway.gateway._announce_file("lab", ServerFile(path, len(content)))
        received = [await client.read()]
        while received[-1][0] == DATA:
            received.append(await client.read())
        assert received[-1] == (C3D, content)
        events = [each for _, body in received[:-1] for each in events_in(body)]
        for _ in range(30):
            packet_type, body = await client.read()
            assert packet_type == DATA
            events += events_in(body)
        assert events == list(range(events[0], events[0] + len(events)))
        half_open.send(command("Version 1.0"))
        assert await half_open.read() == (COMMAND, b"OK-Version 1.0")  # and no file before it


def events_in(body: bytes) -> list[int]:
    return [int(item[0]) for each in components_in(body) if each.type == EVENT for item in each.items]


def losses_of(gateway: ServingGateway) -> Sequence[Loss]:
    [(_, status)] = gateway.source.fan_out.outputs
    losses: Sequence[Loss] = status.losses
    return losses


async def test_a_file_that_is_gone_is_left_out(tmp_path: Path) -> None:
    async with playing() as (_, gateway), connected(gateway) as client:
        await client.ask("StreamFrames 3D")
        gateway.gateway._announce_file("lab", ServerFile(tmp_path / "gone.c3d", 1000))
        assert consecutive(await client.frames(30))
        await until(lambda: bool(losses_of(gateway)))
        [loss] = losses_of(gateway)
    assert (loss.cause, loss.messages) == ("C3D file", 1)
    assert "does not get gone.c3d: No such file or directory; " in loss.text


async def ask_for_frames(client: RawClient, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask for the current frame, again and again, and let all requests wait."""
    monkeypatch.setattr(live_frames, "_LEARN_US", 60_000_000)
    for _ in range(count):
        assert (await client.ask("SendCurrentFrame Force"))[0] == COMMAND


async def file_that_is_not_read(client: RawClient, gateway: ServingGateway, folder: Path) -> bytes:
    """Let the gateway send a file to a client that does not read; return the file's content."""
    content = bytes(20_000_000)
    path = folder / "long.c3d"
    path.write_bytes(content)
    client.pause()
    gateway.gateway._announce_file("lab", ServerFile(path, len(content)))
    await until(lambda: any(each.filter.is_busy for each in gateway.server.connections))
    return content


async def test_no_data_waits_for_the_end_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with playing() as (simulator, gateway), connected(gateway) as client:
        await ask_for_frames(client, 100, monkeypatch)
        content = await file_that_is_not_read(client, gateway, tmp_path)
        simulator.stop_measurement()
        await until(lambda: gateway.server.elapsed_us() is None)
        client.resume()
        assert await client.read() == (C3D, content)
        for _ in range(100):
            assert await client.read() == (NO_DATA, b"")
        assert not losses_of(gateway)


async def test_no_data_beyond_what_can_wait_is_counted_and_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(client_filter, "MAX_HELD_PACKETS", 10)
    async with playing() as (simulator, gateway), connected(gateway) as client:
        await ask_for_frames(client, 30, monkeypatch)
        content = await file_that_is_not_read(client, gateway, tmp_path)
        simulator.stop_measurement()
        await until(lambda: gateway.server.elapsed_us() is None)
        client.resume()
        assert await client.read() == (C3D, content)
        for _ in range(10):
            assert await client.read() == (NO_DATA, b"")
        assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
        [loss] = losses_of(gateway)
    assert (loss.cause, loss.messages, loss.frames) == (SLOW_CLIENT, 20, 0)
    assert caplog.text.count("reads a C3D file too slowly") == 1


async def test_a_client_that_was_full_before_a_file_is_answered_after_it(tmp_path: Path) -> None:
    scene = CountingScene(150.0, num_markers=3000)
    async with playing(scene) as (_, gateway), connected(gateway) as client:
        await client.ask("StreamFrames 3D")
        client.pause()
        [connection] = gateway.server.connections
        await until(lambda: connection._is_full)
        content = await file_that_is_not_read(client, gateway, tmp_path)
        client.resume()
        while (received := await client.read())[0] == DATA:
            pass
        assert received == (C3D, content)
        assert await client.ask_while_streaming("Version 1.0") == b"OK-Version 1.0"


# Limits -------------------------------------------------------------------------------------


async def test_a_slow_client_loses_only_its_own_frames_and_no_event(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    scene = CountingScene(150.0, num_markers=3000)
    async with playing(scene) as (_, gateway), connected(gateway) as slow, connected(gateway) as other:
        slow.pause()
        slow.send(command("StreamFrames 3D Events"))
        await other.ask("StreamFrames 6D")
        while "lab to rtc3d: client" not in caplog.text:
            assert consecutive(await other.frames(20))
        while not losses_of(gateway):
            await other.frames(20)
        assert {loss.cause for loss in losses_of(gateway)} == {SLOW_CLIENT}

        slow.resume()
        assert (await slow.read())[0] == COMMAND
        events: list[int] = []
        previous = 0
        has_gap = False
        while not has_gap or len(events) < 5:
            packet_type, body = await slow.read()
            assert packet_type == DATA
            events += events_in(body)
            number = struct.unpack_from(">i", body, 12)[0]
            has_gap = has_gap or bool(previous and number > previous + 1)
            previous = number
        assert events == list(range(events[0], events[0] + len(events)))
    # On a busy computer, the gateway itself may be a client that does not read in time.
    assert caplog.text.count("lab to rtc3d: client") == 1


async def test_events_that_wait_for_too_long_are_counted_and_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(live_frames, "KEPT_EVENTS", 3)
    async with playing() as (_, gateway), connected(gateway) as client:
        await client.ask("StreamFrames FrequencyDivisor:100 3D Events")
        assert [len(events_in((await client.read())[1])) for _ in range(3)][1:] == [3, 3]
        await until(lambda: any(loss.messages >= 2 for loss in losses_of(gateway)))
        [loss] = losses_of(gateway)
    assert loss.cause == SLOW_CLIENT
    assert caplog.text.count("has not taken frames for so long that events are dropped") == 1


async def test_clients_that_are_too_many_are_turned_away() -> None:
    async with playing(rtc3d={"max_clients": 2}) as (_, gateway):
        async with connected(gateway) as first, connected(gateway) as second:
            for client in (first, second):
                await client.ask("StreamFrames 3D")
            async with connected(gateway) as third:
                [(packet_type, text)] = packets_in(await third.rest())
                assert packet_type == ERROR
                assert text == b"Error-This gateway serves 2 clients at most; closing"
            assert consecutive(await first.frames(10))
        await until(lambda: not gateway.server.connections)
        async with connected(gateway) as client:
            assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


async def test_many_clients_together_have_a_limit() -> None:
    async with playing(rtc3d={"max_clients": 1000}) as (_, gateway), connected(gateway) as client:
        await client.ask("Version 1.0")
        [connection] = gateway.server.connections
        assert connection.transport.get_write_buffer_limits()[1] * 1000 <= 512 * 2**20


async def test_a_connection_without_a_command_makes_room_for_a_client() -> None:
    async with (
        playing(rtc3d={"max_clients": 2}) as (_, gateway),
        connected(gateway) as good,
        connected(gateway) as silent,
    ):
        await good.ask("Version 1.0")
        await until(lambda: len(gateway.server.connections) == 2)
        async with connected(gateway) as client:
            assert await client.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")
            assert await silent.rest() == b""
        assert await good.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


async def test_a_client_without_a_command_is_disconnected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_filter, "FIRST_COMMAND_S", 0.05)
    async with playing() as (_, gateway), connected(gateway) as good:
        await good.ask("Version 1.0")
        async with connected(gateway) as silent, connected(gateway) as wrong:
            wrong.send(command("Fly"))
            assert packets_in(await silent.rest()) == [(ERROR, b"Error-No command within 0.05 s; closing")]
            assert [each[0] for each in packets_in(await wrong.rest())] == [ERROR, ERROR]
        assert await good.ask("Version 1.0") == (COMMAND, b"OK-Version 1.0")


@pytest.mark.parametrize("sent", [b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"])
async def test_a_client_of_another_protocol_is_disconnected(sent: bytes) -> None:
    async with playing() as (_, gateway), connected(gateway) as client:
        client.send(sent)
        [(packet_type, text)] = packets_in(await client.rest())
        assert packet_type == ERROR
        assert b"out of bounds" in text


@pytest.mark.parametrize("sent", [command("") * 400_000, command("x" * 60_000) * 300])
async def test_little_is_kept_of_what_a_client_sends_too_fast(sent: bytes) -> None:
    async with playing() as (_, gateway), connected(gateway) as flooding:
        flooding.send(sent)
        for _ in range(50):
            assert (await flooding.read())[0] == ERROR
            [connection] = gateway.server.connections
            num_bytes = sum(8 + len(each.body) for each in connection._inbox)
            assert num_bytes + connection._reader.buffered_bytes < 70_000


async def test_a_flood_of_commands_delays_nobody() -> None:
    async with playing() as (_, gateway), connected(gateway) as flooding, connected(gateway) as other:
        flooding.send(command("Version 1.0") * 100_000)
        await other.ask("StreamFrames 3D")
        assert consecutive(await other.frames(50))
        for _ in range(500):
            assert await flooding.read() == (COMMAND, b"OK-Version 1.0")
