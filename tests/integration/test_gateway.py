"""A whole gateway that publishes into memory, against servers with deviations from the field notes."""

from itertools import pairwise

import numpy as np
import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.commands import FrequencyDivisor
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from gateway.stream.state import StreamState
from tests.memory_gateway import run_gateway


@pytest.mark.parametrize("byte_order", ["big", "little"])
async def test_every_component_of_the_simulator_is_published(byte_order: str) -> None:
    scene = SyntheticScene(markers=5, tools=1, analog=3, plates=1, rate_hz=200, analog_rate_hz=200)
    counts = {
        "3d": "markers 5",
        "6d": "tools 1",
        "analog": "channels 3",
        "force": "plates 1",
        "event": "events 1",
    }
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
        for component, step, count in (("analog", 1, 100), ("3d", 4, 10)):
            numbers = [message.frame_number for message in await gateway.wait_for(component, count)]
            assert {after - before for before, after in pairwise(numbers)} == {step}
        assert len(simulator.connections) == 2
        assert gateway.status.rate == "FrequencyDivisor:4"
