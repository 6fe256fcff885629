"""Tests that the gateway and the relay of the benchmarks do the same work."""

import math
import re
from collections.abc import Sequence
from configparser import ConfigParser
from pathlib import Path

import pytest

from benchmarks import outputs
from benchmarks.processes import NATIVE_RELAYS
from benchmarks.subscribers import Received
from benchmarks.workbench import GATEWAY, NATIVE, PLAIN_TCP, RELAY, WITHOUT_HISTORY, Workbench
from benchmarks.workloads import DENSE, Frames, cuts
from gateway.messages.encode import CONTENT_OFFSET
from gateway.outputs.registry import OUTPUTS
from gateway.rtc3d.components import ComponentType
from tests.support.documents import ROOT

FRAMES = 200


def published(received: Received, name: str) -> dict[str, tuple[int, int]]:
    """Return how many messages and bytes of each component one subscriber received from source ``name``."""
    return {
        re.split("[/_]", topic)[2].lower(): (received.messages[topic], received.message_bytes[topic])
        for topic in received.messages
        if re.split("[/_]", topic)[1].lower() == name
    }


@pytest.mark.netns
@pytest.mark.parametrize("names", [("zenoh",), ("lcm",), ("zenoh", "lcm")], ids=" and ".join)
def test_the_gateway_and_the_relays_publish_the_same_number_of_messages_and_bytes(
    names: Sequence[str],
) -> None:
    """The native relays, too, where they are built."""
    has_native = len(names) == 1 and NATIVE_RELAYS[names[0]].exists()
    clients = [GATEWAY, WITHOUT_HISTORY, RELAY, *([NATIVE] if has_native else [])]
    zenoh, lcm = "zenoh" in names, "lcm" in names
    with Workbench(
        DENSE, zenoh=zenoh, lcm=lcm, subscribers=[(zenoh, lcm)], reads=True, clients=[*clients, PLAIN_TCP]
    ) as workbench:
        workbench.settle(math.inf)  # the frames sent while subscribers connected
        workbench.take_received()
        for name in clients:
            workbench.pace(name, FRAMES, DENSE.rate_hz)
        workbench.settle(len(clients) * 5 * FRAMES)
        subscribers = workbench.take_received()
    packet = DENSE.packet()
    expected = {cut.component.key: (FRAMES, FRAMES * (cut.last - cut.first)) for cut in cuts(packet)}
    assert set(expected) == {component.key for component in ComponentType}
    assert len(subscribers) == len(names)
    for received in subscribers:
        for name in clients:
            assert published(received, name) == expected


@pytest.mark.netns
def test_the_peer_of_each_output_receives_everything() -> None:
    with outputs.Bench() as bench:
        bench.connect_peers()
    assert set(bench.peers) == {outputs.RELAY, *OUTPUTS} - {"takes"}


def test_the_gateway_and_the_lsl_peer_share_the_recommended_configuration(tmp_path: Path) -> None:
    """Peers with another search than the page recommends could miss streams, and with another session all."""
    at = outputs.Endpoints(0, "", tmp_path)
    config = ConfigParser()
    config.read(outputs.CASES["lsl"].settings(at)["config"])
    first = dict(config["multicast"]), config["lab"]["SessionID"]
    config.read(outputs.CASES["lsl"].settings(at)["config"])
    assert (dict(config["multicast"]), config["lab"]["SessionID"]) == first
    page = (ROOT / "docs/how-to/lsl.md").read_text().partition("```ini\n")[2].partition("```")[0]
    recommended = ConfigParser()
    recommended.read_string(page)
    assert first[0] == dict(recommended["multicast"])


def test_frames_are_numbered_and_stamped_in_every_component() -> None:
    packet = DENSE.packet()
    frames = Frames(packet, 3)
    frames.stamp(7, 100)
    for index in range(3):
        frame = bytes(frames.data[index * len(packet) : (index + 1) * len(packet)])
        for cut in cuts(packet):
            content = frame[cut.first + CONTENT_OFFSET :]
            assert int.from_bytes(content[:4]) == 7 + index
            assert int.from_bytes(content[4:12]) == 100 + index
