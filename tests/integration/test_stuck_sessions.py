"""A whole gateway on real sockets, and servers that ignore commands, refuse without a name, and hang."""

import asyncio
import logging

import pytest

from gateway.simulator.faults.kinds import parse_fault
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.memory_gateway import run_gateway
from tests.servers import Client, ScriptedServer, error, markers_frame, ok, packet
from tests.waiting import wait_until_async

NO_DATA = packet(4)
MAX_WELL_S = 10.0


def scene() -> SyntheticScene:
    return SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=200, analog_rate_hz=200)


async def ignore_and_refuse(client: Client) -> None:
    """Ignore Version and SendParameters; refuse all but StreamFrames without saying what is refused."""
    while True:
        command = await client.command()
        if command == "StreamFrames":
            client.send(ok("fine") + markers_frame(1, (1.0, 2.0, 3.0)))
        elif not command.startswith(("Version", "SendParameters")):
            client.send(error("what?"))


async def test_a_server_that_ignores_and_refuses_without_a_name_streams() -> None:
    async with ScriptedServer(ignore_and_refuse) as server, run_gateway(server.port) as lab:
        await lab.wait_for("3d")
        assert server.connections == 1
        assert lab.status.limitations[:2] == [
            "the server did not answer Version 1.0",
            "the server did not answer SendParameters",
        ]


async def test_a_server_that_ignores_version_is_not_reconnected_for_ever() -> None:
    probes: list[str] = []

    async def script(client: Client) -> None:
        while True:
            command = await client.command()
            probes.append(command)
            if not command.startswith("Version"):
                client.send(ok(command) + (NO_DATA if command.startswith("StreamFrames") else b""))

    async with ScriptedServer(script) as server, run_gateway(server.port, stall_timeout_s=0.2) as lab:
        await lab.wait_until(lambda: len(probes) > 12)
        assert server.connections == 1
        assert lab.status.state is StreamState.NO_MEASUREMENT
        assert probes.count("Version 1.0") == 1


async def test_a_server_that_accepts_and_sends_nothing_is_asked_again_then_left_with_a_reason() -> None:
    commands: list[list[str]] = []

    async def script(client: Client) -> None:
        commands.append(mine := [])
        while True:
            mine.append(await client.command())
            client.send(ok(f"OK-{mine[-1]}"))
            if len(commands) > 1 and mine[-1].startswith("StreamFrames"):
                client.send(markers_frame(1, (1.0, 2.0, 3.0)))

    async with ScriptedServer(script) as server, run_gateway(server.port, stall_timeout_s=0.3) as lab:
        await lab.wait_for("3d")
        assert server.connections == 2
        assert [each for each in commands[0] if each.startswith("StreamFrames")] == [
            "StreamFrames AllFrames"
        ] * 2
        assert "sends neither frames nor No Data, although the gateway asked again" in lab.status.last_error


@pytest.mark.parametrize("hangs_at_first", [True, False])
async def test_a_minimal_server_that_hangs_streams_soon_after_it_is_well(hangs_at_first: bool) -> None:
    async with asyncio.TaskGroup() as tries:
        for hang_s in (0.5, 1.0, 1.6, 3.0):
            tries.create_task(streams_soon_after_a_hang(hang_s, hangs_at_first))


async def streams_soon_after_a_hang(hang_s: float, hangs_at_first: bool) -> None:
    async with Simulator(scene()) as simulator:
        simulator.faults.begin(parse_fault("minimal_server"))
        hang = simulator.faults.begin(parse_fault("half_open")) if hangs_at_first else None
        async with run_gateway(simulator.port) as lab:
            if hang is None:
                await lab.wait_for("3d")
                hang = simulator.faults.begin(parse_fault("half_open"))
            await asyncio.sleep(hang_s)
            simulator.faults.end(hang)
            frames_before = lab.status.frames_in
            await wait_until_async(
                lambda: (
                    lab.status.frames_in > frames_before + 20 and lab.status.state is StreamState.STREAMING
                ),
                MAX_WELL_S,
            )


async def test_the_log_tells_the_first_connection_and_why_it_ended(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.stream")
    async with Simulator(scene()) as simulator:
        simulator.faults.begin(parse_fault("minimal_server"))
        async with run_gateway(simulator.port) as lab:
            await lab.wait_for("3d", 5)
            [connection] = simulator.connections
            connection.transport.abort()
            await lab.wait_until(lambda: lab.status.session == 2)
            await lab.wait_until(lambda: lab.status.state is StreamState.STREAMING)
    name, server = "lab (3d 6d analog force event)", f"127.0.0.1:{simulator.port}"
    connected = f"{name}: connected to {server}, which accepted StreamFrames FrequencyDivisor:1"
    levels = [record.levelname for record in caplog.records if record.message == connected]
    assert levels == ["INFO", "DEBUG"]
    ended = f"{name}: streaming → waiting to reconnect: the connection ended (the connection to {server}"
    assert [record.levelname for record in caplog.records if record.message.startswith(ended)] == ["DEBUG"]
    loud = [record.message for record in caplog.records if record.levelno >= logging.INFO]
    assert [line for line in loud if line.startswith(f"{name}: the connection to {server}")] == loud[-1:]
    first_streaming = next(line for line in loud if "streaming" in line and "→" in line)
    assert first_streaming.endswith(f"→ streaming: a frame arrived ({server})")
