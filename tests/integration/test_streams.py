"""Changes of a stream on one connection: demand, item counts, lateness, states."""

import asyncio
import math
from functools import partial

import pytest

from gateway.config.settings import StreamSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.memory_gateway import run_gateway
from tests.servers import Client, ScriptedServer, markers_frame, ok, packet

XML = packet(2, "<RT_Parameters Ver='1.00'><The_3D/></RT_Parameters>")


class Recorder:
    """A server that sends a numbered frame at each call of ``stream``, and records its commands."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.client: Client | None = None
        self.number = 0

    async def script(self, client: Client) -> None:
        self.client = client

        def answer(command: str) -> bytes:
            self.commands.append(command)
            return XML if command.startswith("SendParameters") else ok(f"OK-{command}")

        await client.commands(answer)

    def stream(self, *positions: tuple[float, float, float]) -> None:
        assert self.client is not None
        self.number += 1
        self.client.send(markers_frame(self.number, *positions))

    def count(self, command: str) -> int:
        return self.commands.count(command)

    def has(self, command: str, count: int) -> bool:
        return self.count(command) == count


ORIGIN = (0.0, 0.0, 0.0)
START, STOP = "StreamFrames AllFrames", "StreamFrames Stop"


async def test_an_on_demand_stream_runs_while_it_has_subscribers() -> None:
    server = Recorder()
    stream = StreamSettings(on_demand=True, idle_after_s=0.1)
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, streams=(stream,)) as lab,
    ):
        for rounds in (1, 2, 3):
            await lab.wait_until(partial(server.has, START, rounds))
            server.stream(ORIGIN)
            await lab.wait_for("3d", rounds)
            lab.output.has_subscriber = False
            await lab.wait_until(partial(server.has, STOP, rounds))
            await lab.wait_until(lambda: lab.status.state is StreamState.IDLE)
            lab.output.has_subscriber = True
        assert lab.status.session == 1


async def test_other_streams_run_without_subscribers() -> None:
    server = Recorder()
    async with ScriptedServer(server.script) as listening, run_gateway(listening.port) as lab:
        lab.output.has_subscriber = False
        await lab.wait_until(lambda: server.count(START) == 1)
        for number in range(1, 20):
            server.stream(ORIGIN)
            await lab.wait_for("3d", number)
        assert server.count(STOP) == 0


async def test_a_changed_number_of_markers_makes_the_gateway_ask_for_parameters() -> None:
    server = Recorder()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, fresh_interval_s=0.05) as lab,
    ):
        await lab.wait_until(lambda: server.count(START) == 1)
        asked = server.count("SendParameters")
        server.stream(ORIGIN)
        server.stream(ORIGIN)
        await lab.wait_for("3d", 2)
        assert server.count("SendParameters") == asked
        server.stream(ORIGIN, ORIGIN)
        await lab.wait_until(lambda: server.count("SendParameters") == asked + 1)
        assert [message.num_markers for message in await lab.wait_for("3d", 3)] == [1, 1, 2]


async def test_time_stamps_that_go_back_are_a_restart_without_a_reconnect() -> None:
    server = Recorder()
    async with ScriptedServer(server.script) as listening, run_gateway(listening.port) as lab:
        await lab.wait_until(lambda: server.count(START) == 1)
        for _ in range(5):
            server.stream(ORIGIN)
        server.number = 0
        server.stream(ORIGIN)
        await lab.wait_for("3d", 6)
        assert lab.status.restarts == 1
        assert lab.status.session == 1


async def test_states_follow_the_server_and_the_outputs_show_them(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    async with Simulator(SyntheticScene(rate_hz=200, analog_rate_hz=200)) as simulator:
        simulator.stop_measurement()
        async with run_gateway(simulator.port) as lab:
            await lab.wait_until(lambda: lab.status.state is StreamState.NO_MEASUREMENT)
            assert not lab.output.streaming
            simulator.start_measurement()
            await lab.wait_until(lambda: lab.status.state is StreamState.STREAMING)
            await lab.wait_until(lambda: lab.output.streaming == {"lab"})
            simulator.stop_measurement()
            await lab.wait_until(lambda: lab.status.state is StreamState.NO_MEASUREMENT)
            await lab.wait_until(lambda: not lab.output.streaming)
    changes = [record.message for record in caplog.records if "→" in record.message]
    assert sum("no measurement → streaming" in change for change in changes) == 1
    assert sum("streaming → no measurement" in change for change in changes) == 1


@pytest.mark.interpreted
async def test_late_frames_make_the_gateway_request_a_lower_rate_until_they_are_in_time(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The frames arrive in time for 3 s, and then 0.3 s late: their time stamps are older."""
    monkeypatch.setattr("gateway.stream.rate_control.FIRST_WAIT_S", 0.3)
    caplog.set_level("INFO", "gateway.stream")
    server = Recorder()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, streams=(StreamSettings(adapt_rate=True),)) as lab,
    ):
        await lab.wait_until(lambda: server.count(START) == 1)
        loop = asyncio.get_running_loop()
        start_s = loop.time()

        async def stream_until(command: str, late_after_s: float) -> None:
            while server.commands[-1] != command:
                elapsed_s = loop.time() - start_s
                assert elapsed_s < 20
                due = int((elapsed_s - (0.3 if elapsed_s > late_after_s else 0.0)) * 200)
                while server.number < due:
                    server.number += 1
                    assert server.client is not None
                    server.client.send(markers_frame(5 * server.number, ORIGIN))
                await asyncio.sleep(0.005)

        await stream_until("StreamFrames FrequencyDivisor:2", late_after_s=3)
        assert lab.status.lag_s > 0.05
        await lab.wait_until(lambda: lab.status.rate == "FrequencyDivisor:2")
        await stream_until(START, late_after_s=math.inf)
        await lab.wait_until(lambda: lab.status.rate == "AllFrames")
        logged = [(record.levelname, record.message) for record in caplog.records]
    late, in_time = [(level, text) for level, text in logged if "frames arrive" in text]
    assert late[0] == "WARNING"
    assert late[1].endswith(" ms late; asked the server for FrequencyDivisor:2")
    assert in_time[0] == "INFO"
    assert "frames arrive in time; asked the server for AllFrames, after " in in_time[1]
