"""Changes of a stream on one connection: demand, restarts, states."""

from functools import partial

import pytest

from gateway.config.settings import StreamSettings
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.memory_gateway import run_gateway
from tests.servers import Client, ScriptedServer, markers_frame, ok, packet

START, STOP = "StreamFrames AllFrames", "StreamFrames Stop"


class Recorder:
    """A server that sends numbered frames, and records its commands."""

    def __init__(self) -> None:
        self.commands: list[str] = []
        self.client: Client | None = None

    async def script(self, client: Client) -> None:
        self.client = client
        await client.commands(self._answer)

    def _answer(self, command: str) -> bytes:
        self.commands.append(command)
        if command.startswith("SendParameters"):
            return packet(2, "<RT_Parameters Ver='1.00'><The_3D/></RT_Parameters>")
        return ok(f"OK-{command}")

    def stream(self, number: int, num_markers: int = 1) -> None:
        assert self.client is not None
        self.client.send(markers_frame(number, *[(0.0, 0.0, 0.0)] * num_markers))

    def has(self, command: str, count: int) -> bool:
        return self.commands.count(command) == count


async def test_an_on_demand_stream_runs_while_it_has_subscribers() -> None:
    server = Recorder()
    stream = StreamSettings(on_demand=True, idle_after_s=0.1)
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, streams=(stream,)) as lab,
    ):
        for rounds in (1, 2, 3):
            await lab.wait_until(partial(server.has, START, rounds))
            server.stream(rounds)
            await lab.wait_for("3d", rounds)
            lab.output.has_subscriber = False
            await lab.wait_until(partial(server.has, STOP, rounds))
            await lab.wait_until(lambda: lab.status.state is StreamState.IDLE)
            lab.output.has_subscriber = True
        assert lab.status.session == 1


async def test_another_number_of_markers_requests_the_parameters_and_a_restart_keeps_the_connection() -> None:
    server = Recorder()
    async with (
        ScriptedServer(server.script) as listening,
        run_gateway(listening.port, fresh_interval_s=0.05) as lab,
    ):
        lab.output.has_subscriber = False  # only a stream on demand stops
        await lab.wait_until(lambda: server.has(START, 1))
        for number in range(1, 20):
            server.stream(number)
            await lab.wait_for("3d", number)
        assert server.has("SendParameters", 1)
        server.stream(20, num_markers=2)
        await lab.wait_until(lambda: server.has("SendParameters", 2))
        server.stream(1)
        counts = [message.num_markers for message in await lab.wait_for("3d", 21)]
        assert counts == [1] * 19 + [2, 1]
        assert (lab.status.restarts, lab.status.session, server.has(STOP, 0)) == (1, 1, True)


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
            assert lab.status.session == 1
    for change in ("no measurement → streaming", "streaming → no measurement"):
        assert sum(change in text for text in caplog.messages) == 1
