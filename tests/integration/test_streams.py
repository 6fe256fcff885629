"""Streams of a whole gateway: those of its configuration, and those that ``auto`` chooses."""

import asyncio
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, decode_text
from gateway.rtc3d_server.client_connection import ClientConnection, ConnectionFilter
from gateway.rtc3d_server.server import RtServer
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.support.gateways import MemoryGateway, run_gateway

ONE_CONNECTION = "analog and force arrive at 200 Hz instead of 2000 Hz: "
EVERYTHING = "3d 6d analog force event"
TWO = ["3d 6d event", "analog force"]
SCENE = SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=200, analog_rate_hz=2000)


class _Filter(ConnectionFilter):
    """Lets the server handle what its clients do while there is another client."""

    def __init__(self, connection: ClientConnection, server: "OneClientServer") -> None:
        super().__init__(connection)
        self._server = server

    def receive(self, data: bytes) -> None:
        is_second = any(other.number < self.connection.number for other in self._server.connections)
        if is_second and self._server.on_second == "close":
            self.connection.transport.close()
        else:
            super().receive(data)

    def answer(self, packet: Packet) -> list[bytes]:
        text = decode_text(packet.body)
        self._server.commands.append((self.connection.number, text))
        replies = super().answer(packet)
        if text.startswith("StreamFrames") and self._server.num_clients > 1:
            if self._server.on_second == "close_first":
                self._server.close_others(self.connection)
            elif self._server.on_second == "crash":
                self._server.crash_and_restart()
        return replies


class OneClientServer(RtServer):
    """A server with field note 21.

    ``on_second`` says what happens to a second client: "serve", "refuse" or "close" it; or when it
    requests frames: "close_first", "crash".
    """

    def __init__(self, on_second: str) -> None:
        super().__init__(SCENE, new_filter=lambda each: _Filter(each, self))
        self.on_second = on_second
        self.commands: list[tuple[int, str]] = []
        self.num_opened = 0

    @property
    def num_clients(self) -> int:
        return len(self.connections)

    def connection_opened(self, connection: Any) -> int:
        self.num_opened += 1
        if self.on_second == "refuse" and self._server is not None:
            self._server.close()
            self._server = None
        return super().connection_opened(connection)

    @property
    def is_listening(self) -> bool:
        return self.on_second == "refuse" or super().is_listening

    def close_others(self, connection: ClientConnection) -> None:
        for other in list(self.connections):
            if other.number != connection.number:
                other.transport.abort()

    def crash_and_restart(self) -> None:
        self.crash()
        asyncio.get_running_loop().call_later(0.1, lambda: asyncio.ensure_future(self.start()))


def components(lab: MemoryGateway) -> list[str]:
    return [status.components for status in lab.source.statuses]


def step(messages: list[Any]) -> int:
    """Return how far apart frame numbers are; a busy computer skips some."""
    return math.gcd(*(after.frame_number - before.frame_number for before, after in pairwise(messages)))


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_every_component_of_the_simulator_is_published(byte_order: str) -> None:
    scene = SyntheticScene(markers=5, tools=1, analog=3, plates=1, rate_hz=200, analog_rate_hz=200)
    counts = {"3d": "markers 5", "6d": "tools 1", "analog": "channels 3", "force": "plates 1"}
    counts["event"] = "events 1"
    async with (
        Simulator(scene) as simulator,
        run_gateway(simulator.port, byte_order=byte_order) as gateway,
    ):
        for component, (kind, count) in ((key, text.split()) for key, text in counts.items()):
            [message, *_] = await gateway.wait_for(component)
            assert getattr(message, f"num_{kind}") == int(count)
        markers = await gateway.wait_for("3d", 20)
        assert [message.sequence for message in markers] == list(range(len(markers)))
        for message in markers:
            # A scene is a function of time; frames are numbered from 1.
            [items] = scene.items(ComponentType.MARKERS, np.array([message.frame_number - 1]))
            assert [marker.x for marker in message.markers] == items["x"].tolist()
            assert message.session == 1
        status = gateway.status
        expected = (StreamState.STREAMING, byte_order, "AllFrames")
        assert (status.state, status.byte_order, status.rate) == expected


async def test_each_stream_has_its_own_connection_and_its_configured_rate() -> None:
    scene = SyntheticScene(markers=2, tools=0, analog=2, plates=0, rate_hz=200, analog_rate_hz=1000)
    streams = (
        StreamSettings(components=(ComponentType.MARKERS,), rate=FrequencyDivisor(4)),
        StreamSettings(components=(ComponentType.ANALOG,)),
    )
    async with Simulator(scene) as simulator, run_gateway(simulator.port, streams=streams) as gateway:
        assert step(await gateway.wait_for("analog", 100)) == 1
        assert step(await gateway.wait_for("3d", 10)) == 4
        assert len(simulator.connections) == 2
        assert gateway.status.rate == "FrequencyDivisor:4"


async def test_every_component_arrives_at_its_own_rate() -> None:
    async with OneClientServer("serve") as server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 400)
        markers = await lab.wait_for("3d", 20)
        await lab.wait_for("event")
        assert components(lab) == TWO
        assert (step(markers), step(analog), step(lab.messages("force"))) == (1, 1, 1)
        assert [message.sequence for message in analog] == list(range(len(analog)))
        assert [status.limitations for status in lab.source.statuses] == [[], []]
        assert [command for _, command in server.commands if command.startswith("StreamFrames")] == [
            "StreamFrames AllFrames 3D 6D Events",
            "StreamFrames AllFrames Analog Force",
        ]
        assert ({each.session for each in markers}, {each.session for each in analog}) == ({1}, {2})
        assert server.num_opened == 2


class _Nameless(_Filter):
    def answer(self, packet: Packet) -> list[bytes]:
        text = decode_text(packet.body)
        if text.startswith("StreamFrames") and text.rstrip("\0\n").endswith(("3D", "6D", "Events", "Force")):
            return [b"\0\0\0\x0e\0\0\0\0Error-"]
        return super().answer(packet)


async def test_a_server_that_knows_no_component_names_sends_everything_on_one_connection() -> None:
    server = OneClientServer("serve")
    server.new_filter = lambda each: _Nameless(each, server)
    async with server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 100)
        assert step(analog) == 10
        assert components(lab) == [EVERYTHING]
        assert f"{ONE_CONNECTION}the server does not accept the names of components" in lab.status.limitations
        assert server.num_opened == 1


async def new_step(lab: MemoryGateway, component: str, count: int) -> int:
    """Return the steps between ``count`` messages to come, after the first 20 of them."""
    first = len(lab.messages(component)) + 20
    return step((await lab.wait_for(component, first + count))[first:])


def assert_continuous(lab: MemoryGateway) -> None:
    """Check that no message is missing, and that no session comes back."""
    for component in ("3d", "6d", "analog", "force"):
        messages = lab.messages(component)
        assert [each.sequence for each in messages] == list(range(len(messages)))
        assert all(after.session >= before.session for before, after in pairwise(messages))


@pytest.mark.parametrize(
    ("on_second", "reason"),
    [
        ("refuse", "the server accepts one connection only (connection refused by 127.0.0.1:"),
        ("close", "the server accepts one connection only (the connection to 127.0.0.1:"),
        ("close_first", "the server ends the first connection when there is a second one"),
        ("crash", "the server ends the first connection when there is a second one"),
    ],
)
async def test_a_server_for_one_client_sends_everything_on_one_connection(
    on_second: str, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    async with OneClientServer(on_second) as server, run_gateway(server.port) as lab:
        await lab.wait_until(lambda: components(lab) == [EVERYTHING] and lab.status.limitations)
        [limitation] = lab.status.limitations
        assert limitation.startswith(ONE_CONNECTION + reason)
        logged = [text for text in caplog.messages if "instead of 2000 Hz" in text]
        assert logged == [f"lab ({EVERYTHING}): {limitation}"]
        await lab.wait_until(lambda: lab.status.state is StreamState.STREAMING and lab.status.limitations)
        opened = server.num_opened
        assert (await new_step(lab, "3d", 60), await new_step(lab, "analog", 60)) == (1, 10)
        assert_continuous(lab)
        assert lab.status.limitations == [limitation]
        assert (server.num_opened, server.num_clients) == (opened, 1)
        if reason.startswith("the server accepts"):  # and the first connection has streamed all the time
            requests = [number for number, command in server.commands if command.startswith("StreamFrames")]
            assert requests == [1, 1]
