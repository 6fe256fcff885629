"""Takes that follow a server's measurements and recordings, with a real gateway on Zenoh."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from gateway.daemon.gateway import Gateway
from gateway.messages.decode import decode
from gateway.outputs.takes import follow
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.source_takes import SourceTakes
from gateway.takes.files.reader import TakeReader
from tests.support.networks import free_endpoint
from tests.support.queried_gateway import ParameterServer, query, run_gateway, wait_until_cached, zenoh_peer
from tests.support.servers import ScriptedServer, c3d_file, markers_frame, packet
from tests.support.waiting import wait_until_async


def takes_in(folder: Path, setting: str) -> TakesSettings:
    return TakesSettings.model_validate({"enabled": True, "directory": str(folder), "follow": setting})


async def opened(gateway: Gateway) -> SourceTakes:
    """Wait until the gateway knows the parameters and records takes; return them."""
    await wait_until_cached(gateway)
    await wait_until_async(lambda: all(output.health().connected for output in gateway.outputs))
    [output] = [output.output for output in gateway.outputs if isinstance(output.output, TakesOutput)]
    return output.takes("lab")


def frame_numbers(path: Path) -> list[int]:
    messages = TakeReader(path).messages()
    return [decode(message.message).frame_number for message in messages if message.key == "3d"]


async def test_each_measurement_has_one_take(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follow, "END_S", 0.01)
    server, endpoint = ParameterServer(), free_endpoint()
    server.has_measurement = False
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, listen=endpoint, takes=takes_in(tmp_path, "measurement")) as gateway,
    ):
        takes = await opened(gateway)
        [source] = gateway.sources
        for first in (100, 200):
            for number in range(first, first + 20):
                server.send(markers_frame(number))
            await wait_until_async(lambda: takes.take is not None)
            if first == 200:
                before, former, server.has_measurement = takes.take, server.client, True
                assert former is not None
                former.cut()
                await wait_until_async(lambda: server.client is not former)  # noqa: B023
                await wait_until_cached(gateway)
                server.send(markers_frame(250))
                await wait_until_async(lambda: sum(status.frames_in for status in source.statuses) >= 42)
                assert takes.take is before
            server.send(packet(4))
            await wait_until_async(lambda: takes.take is None)
    first_take, second_take = sorted((tmp_path / "lab").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert frame_numbers(first_take) == [*range(100, 120)]
    second = frame_numbers(second_take)
    assert (second[:20], second[-1]) == ([*range(200, 220)], 250)


async def test_a_named_recording_has_a_take_and_a_c3d_file_of_the_same_name(tmp_path: Path) -> None:
    server, endpoint = ParameterServer(), free_endpoint()
    takes = tmp_path / "takes"
    options: dict[str, Any] = {"listen": endpoint, "spool": tmp_path / "spool", "remote_control": True}
    await asyncio.to_thread(takes.mkdir)
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, takes=takes_in(takes, "recording"), **options) as gateway,
    ):
        await opened(gateway)
        with zenoh_peer(endpoint) as peer:
            reply = await query(peer, "mocap/lab/recording?set=start;name=walk-1")
            assert reply.json.items() >= {"sent": "start", "name": "walk-1", "take": "walk-1"}.items()
            assert server.commands[-1] == "Recording Start,file=walk-1"
            for number in range(10):
                server.send(markers_frame(number))
            [source] = gateway.sources
            await wait_until_async(lambda: sum(status.frames_in for status in source.statuses) >= 11)
            reply = await query(peer, "mocap/lab/recording?set=stop")
            assert reply.json == {"source": "lab", "sent": "stop", "take": "walk-1"}
            content = c3d_file(b"of walk-1")
            server.send(packet(5, content))
            await wait_until_async((takes / "lab/walk-1.c3d").exists)
    assert frame_numbers(takes / "lab/walk-1.lcmlog") == list(range(10))
    assert (takes / "lab/walk-1.c3d").read_bytes() == content
