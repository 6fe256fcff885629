"""The VRPN output and its publishers without a network: poses, trackers, losses."""

import logging
import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.messages.topics import Topic
from gateway.outputs.adapters.vrpn.output import MAX_TOOLS, VrpnOutput, VrpnPublisher
from gateway.outputs.adapters.vrpn.protocol import encode_pose
from gateway.outputs.adapters.vrpn.settings import VrpnSettings
from gateway.outputs.adapters.vrpn.trackers import Trackers
from gateway.outputs.contract import ServerParameters
from gateway.rtc3d.components import ITEM_DTYPES, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.rtc3d.parameters import Parameters, Parameters6D, Tool
from gateway.runtime.losses import Losses
from tests.support.errors import names
from tests.support.networks import free_port
from tests.support.records import levels
from tests.support.statuses import amounts

TOOLS = frozenset({ComponentType.TOOLS})
UTIME = 1_700_000_000_000_000
STAMP = Stamp(UTIME + 5, UTIME, 1, 1)


def parameters(*labels: str, unit_m: float | None = 1e-3) -> ServerParameters:
    parsed = Parameters(tools=Parameters6D(100.0, tuple(Tool("", label) for label in labels)))
    return ServerParameters(b"", 1, 1, parsed=parsed, frame=CoordinateFrame("lab", unit_m))


def frame(*components: Sequence[float], order: ByteOrder = "big") -> RawFrame:
    """Return a frame with one component of tools for each list of positions in mm."""
    arrays = [
        np.array([(1.0, 0.0, 0.0, 0.0, x, 0.0, 0.0, 0.0) for x in xs], ITEM_DTYPES[ComponentType.TOOLS])
        for xs in components
    ]
    encoded = [encode_component(ComponentType.TOOLS, 1, 1000, items, order) for items in arrays]
    return split_frame(encode_frame(encoded, order), order)


def poses(*xs_m: float, numbers: Sequence[int] = range(1000)) -> bytes:
    """Return the poses of these trackers, by default the first ones."""
    placed = zip(numbers, xs_m, strict=False)
    return b"".join(encode_pose(number, UTIME, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for number, x in placed)


class Server:
    """A VrpnServer that keeps what is sent; ``slow`` are the clients that miss it."""

    def __init__(self) -> None:
        self.trackers = Trackers("auto")
        self.has_clients = True
        self.sent: list[bytes] = []
        self.slow: list[str] = []
        self.num_described = 0

    def send(self, poses: bytes) -> list[str]:
        self.sent.append(poses)
        return self.slow

    def describe_trackers(self) -> None:
        self.num_described += 1


class Lab:
    """The publisher of "lab"; the test makes the calls that it hands over."""

    def __init__(self, *labels: str) -> None:
        self.server = Server()
        self.calls: list[tuple[Callable[[], None], int]] = []
        self.is_full = False
        self.publisher = VrpnPublisher("lab", self.server, self._offer)  # type: ignore[arg-type]
        self.losses = self.publisher.losses = Losses(logging.getLogger(__name__), "lab to vrpn")
        self.publisher.set_parameters(parameters(*labels))

    def _offer(self, call: Callable[[], None], num_bytes: int) -> bool:
        if not self.is_full:
            self.calls.append((call, num_bytes))
        return not self.is_full

    def run(self) -> None:
        while self.calls:
            self.calls.pop(0)[0]()

    def offer(self, frame: RawFrame) -> None:
        self.publisher.publish(frame, STAMP, TOOLS)

    def send(self, *components: Sequence[float], order: ByteOrder = "big") -> None:
        self.offer(frame(*components, order=order))
        self.run()

    @property
    def lost(self) -> dict[str, Any]:
        return {cause: messages for cause, (messages, _) in amounts(self.losses.report()).items()}


def test_tools_have_trackers_from_the_parameters_or_from_their_frames() -> None:
    """They are described to clients when they are new, and only then."""
    lab = Lab("wand")
    lab.run()
    assert (list(lab.server.trackers.of_source("lab")), lab.server.num_described) == (["wand"], 1)
    lab.send([1000.0])
    lab.send([2000.0, 3000.0])
    lab.send([1000.0])
    assert lab.server.sent == [poses(1.0), poses(2.0, 3.0), poses(1.0)]
    assert (list(lab.server.trackers.of_source("lab")), lab.server.num_described) == (["wand", "tool 2"], 2)
    lab.is_full = True
    lab.publisher.set_parameters(parameters("cup", "pan"))  # the next frame names the trackers
    lab.is_full = False
    lab.send([1000.0])
    assert list(lab.server.trackers.of_source("lab")) == ["cup", "pan"]
    lab.publisher.close()
    lab.run()
    assert not lab.server.trackers.of_source("lab")


def test_frames_are_named_by_the_parameters_before_them() -> None:
    lab = Lab("wand", "foot")
    lab.offer(frame([1000.0]))
    lab.publisher.set_parameters(parameters("hand", "foot"))
    lab.offer(frame([2000.0]))
    lab.run()
    assert lab.server.sent == [poses(1.0), poses(2.0, numbers=[2])]


def test_poses_of_every_component_and_byte_order_are_sent_without_those_of_hidden_tools() -> None:
    lab = Lab("wand", "foot")
    lab.send([1000.0, 2000.0], order="little")
    lab.send([4000.0], [5000.0])
    lab.send([math.nan, 2000.0])
    lab.send([math.nan])
    assert lab.server.sent == [poses(1.0, 2.0), poses(4.0) + poses(5.0), poses(2.0, numbers=[1])]


def test_tools_beyond_the_limit_are_counted_and_not_sent() -> None:
    """Over all components of a frame."""
    lab = Lab()
    lab.send([0.0] * MAX_TOOLS)
    assert lab.lost == {}
    lab.send([0.0] * (MAX_TOOLS + 3))
    assert lab.lost == {"too many tools": 3}
    lab.send([0.0] * 200, [0.0] * 50, [0.0] * 100)
    assert lab.lost == {"too many tools": 3 + 94}
    assert [len(sent) for sent in lab.server.sent] == [len(poses(*[0.0] * MAX_TOOLS))] * 3


def test_each_client_that_misses_poses_counts() -> None:
    """Two poses for three clients are six."""
    lab = Lab("wand", "cup")
    lab.server.slow = ["a", "b", "c"]
    lab.send([1.0, 2.0])
    assert lab.lost == {"slow client": 6}


def test_frames_are_handed_over_while_a_client_is_connected() -> None:
    """What cannot be sent is refused with its cause."""
    lab, one = Lab(), frame([1000.0])
    lab.run()
    lab.server.has_clients = False
    lab.offer(one)
    assert (lab.publisher.wants(TOOLS), lab.calls) == (False, [])
    assert not lab.publisher.prepare(one.layout, TOOLS)
    lab.server.has_clients = True
    assert lab.publisher.prepare(one.layout, TOOLS)
    assert not lab.publisher.prepare(one.layout, frozenset({ComponentType.MARKERS}))
    assert not lab.publisher.prepare(frame([]).layout, TOOLS)
    lab.offer(one)
    assert lab.calls[-1][1] == len(one.body)
    lab.is_full = True
    for given, cause in ((parameters(), "queue full"), (parameters(unit_m=None), "unknown unit")):
        lab.publisher.set_parameters(given)
        with pytest.raises(OutputError) as refused:
            lab.offer(one)
        assert refused.value.cause == cause


def test_a_reload_replaces_the_output_only_if_its_settings_differ() -> None:
    output = VrpnOutput(VrpnSettings(port=4000))
    others = [VrpnOutput(VrpnSettings(port=port)) for port in (4000, 4001)]
    assert [output.is_configured_like(other) for other in others] == [True, False]
    topic = output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
    topic.publish(b"")
    assert not topic.wanted


def test_names_of_trackers_that_are_not_the_labels_are_shown() -> None:
    output = VrpnOutput(VrpnSettings())
    output._server.trackers.set_tools("lab", ["Left Foot", "wand"])
    assert output.topic_names("lab") == {"6d": {"Left Foot": "Left_Foot"}}
    assert output.topic_names("stage") == {}


def test_a_defect_in_the_thread_is_logged_once_and_later_calls_are_made(
    caplog: pytest.LogCaptureFixture,
) -> None:
    output = VrpnOutput(VrpnSettings(port=free_port()))
    output.start()
    done = threading.Event()
    calls: list[Callable[[], Any]] = [lambda: 1 / 0, lambda: 1 / 0, done.set]
    assert all(output._offer(call, 0) for call in calls)
    assert done.wait(10)
    output.close()
    assert levels(caplog) == ["ERROR"]
    assert names(caplog.messages[-1], "ZeroDivisionError")
