"""The limits of RTC3D clients of a gateway: files, slow clients, too many clients, floods."""

import logging
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.losses import Loss
from gateway.outputs.contract import ServerFile
from gateway.outputs.rtc3d.live_server import SLOW_CLIENT
from tests.integration.raw_client import RawClient, connected, consecutive, until
from tests.serving_gateway import ServingGateway, playing
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    COMMAND,
    DATA,
    ERROR,
    EVENT,
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


async def file_that_is_not_read(client: RawClient, gateway: ServingGateway, folder: Path) -> bytes:
    """Let the gateway send a file to a client that does not read; return the file's content."""
    content = bytes(20_000_000)
    path = folder / "long.c3d"
    path.write_bytes(content)
    client.pause()
    gateway.gateway._announce_file("lab", ServerFile(path, len(content)))
    await until(lambda: any(each.filter.is_busy for each in gateway.server.connections))
    return content


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
