"""The benchmarks compare like with like, and their documents are made of their results."""

import math
import re

import pytest

from benchmarks.stage import GATEWAY, RELAY, Stage
from benchmarks.subscribers import Heard
from benchmarks.workloads import DENSE, Frames, cuts
from gateway.rtc3d.components import ComponentType

FRAMES = 200


def published(heard: Heard, name: str) -> dict[str, tuple[int, int]]:
    """Return the messages and bytes of each component that one subscriber had from the source ``name``."""
    return {
        re.split("[/_]", topic)[2].lower(): (heard.messages[topic], heard.message_bytes[topic])
        for topic in heard.messages
        if re.split("[/_]", topic)[1].lower() == name
    }


@pytest.mark.netns
def test_the_gateway_and_the_relay_publish_the_same_number_of_messages_and_bytes() -> None:
    with Stage(DENSE, subscribers=[(1, 1)], reads=True) as stage:
        stage.settle(math.inf)  # what was sent until all subscribers were there
        stage.take()
        for name in (GATEWAY, RELAY):
            stage.pace(name, FRAMES, DENSE.rate_hz)
        stage.settle(2 * 5 * FRAMES)
        sides = stage.take()
    packet = DENSE.packet()
    expected = {cut.component.key: (FRAMES, FRAMES * (cut.last - cut.first)) for cut in cuts(packet)}
    assert set(expected) == {component.key for component in ComponentType}
    for heard in sides:
        assert published(heard, GATEWAY) == expected
        assert published(heard, RELAY) == expected


def test_frames_are_numbered_and_stamped_in_every_component() -> None:
    packet = DENSE.packet()
    frames = Frames(packet, 3)
    frames.stamp(7, 100)
    for index in range(3):
        frame = bytes(frames.data[index * len(packet) : (index + 1) * len(packet)])
        for cut in cuts(packet):
            content = frame[cut.first + 36 :] if cut.first + 36 >= 0 else b""
            assert int.from_bytes(content[:4]) == 7 + index
            assert int.from_bytes(content[4:12]) == 100 + index
