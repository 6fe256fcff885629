"""Streams of a whole gateway: those of its configuration, and those that ``auto`` chooses."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.packets import Packet, decode_text
from gateway.session.server.client_connection import ClientConnection, ConnectionFilter
from gateway.session.server.server import RtServer
from gateway.session.state import StreamState
from gateway.session.streams import NO_NAMES
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import one_names
from tests.support.gateways import MemoryGateway, run_gateway

EVERYTHING = "3d 6d analog force event"
TWO = ["3d 6d event", "analog force"]
SCENE = SyntheticScene(markers=3, tools=1, analog=2, plates=1, rate_hz=200, analog_rate_hz=2000)


class _Filter(ConnectionFilter):
    """Records the commands of its client, and refuses those with ``refused`` at their end."""

    def __init__(self, connection: ClientConnection, server: "RecordingServer") -> None:
        super().__init__(connection)
        self._server = server

    def answer(self, packet: Packet) -> list[bytes]:
        text = decode_text(packet.body)
        self._server.commands.append(text)
        if text.startswith("StreamFrames") and text.endswith(self._server.refused):
            return [b"\0\0\0\x0e\0\0\0\0Error-"]
        return super().answer(packet)


class RecordingServer(RtServer):
    """A server of SCENE that records the commands and the number of its connections."""

    def __init__(self, *refused: str) -> None:
        super().__init__(SCENE, new_filter=lambda each: _Filter(each, self))
        self.refused = refused
        self.commands: list[str] = []
        self.num_opened = 0

    def connection_opened(self, connection: Any) -> int:
        self.num_opened += 1
        return super().connection_opened(connection)


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
    async with RecordingServer() as server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 400)
        markers = await lab.wait_for("3d", 20)
        await lab.wait_for("event")
        assert components(lab) == TWO
        assert (step(markers), step(analog), step(lab.messages("force"))) == (1, 1, 1)
        assert [message.sequence for message in analog] == list(range(len(analog)))
        assert [status.limitations for status in lab.source.statuses] == [[], []]
        assert [command for command in server.commands if command.startswith("StreamFrames")] == [
            "StreamFrames AllFrames 3D 6D Events",
            "StreamFrames AllFrames Analog Force",
        ]
        assert ({each.session for each in markers}, {each.session for each in analog}) == ({1}, {2})
        assert server.num_opened == 2


async def test_a_server_that_knows_no_component_names_sends_everything_on_one_connection() -> None:
    async with RecordingServer("3D", "6D", "Events", "Force") as server, run_gateway(server.port) as lab:
        analog = await lab.wait_for("analog", 100)
        assert step(analog) == 10
        assert components(lab) == [EVERYTHING]
        assert one_names(lab.status.limitations, "analog and force", "200 Hz", "2000 Hz", NO_NAMES)
        assert server.num_opened == 1
