"""The publisher of one source on VRPN without a network: its poses, trackers and losses."""

import logging
from collections.abc import Callable
from typing import Any

import pytest

from gateway.errors import OutputError
from gateway.losses import Losses
from gateway.outputs.vrpn.protocol import encode_pose
from gateway.outputs.vrpn.publisher import MAX_TOOLS, VrpnPublisher
from gateway.outputs.vrpn.trackers import Trackers
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import Frame, encode_frame, split_frame
from tests.losses import amounts
from tests.unit.outputs.vrpn.test_output import parameters, stamp, tools_component

TOOLS = frozenset({ComponentType.TOOLS})
UTIME = 1_700_000_000_000_000


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

    def __init__(self) -> None:
        self.server = Server()
        self.calls: list[tuple[Callable[[], None], int]] = []
        self.is_full = False
        self.publisher = VrpnPublisher("lab", self.server, self._offer)  # type: ignore[arg-type]
        self.losses = self.publisher.losses = Losses(logging.getLogger(__name__), "lab to vrpn")

    def _offer(self, call: Callable[[], None], num_bytes: int) -> bool:
        if not self.is_full:
            self.calls.append((call, num_bytes))
        return not self.is_full

    def run(self) -> None:
        while self.calls:
            self.calls.pop(0)[0]()

    def send(self, *components: list[float]) -> None:
        self.publisher.publish(frame(*components), stamp(UTIME), 0, TOOLS)
        self.run()

    @property
    def lost(self) -> dict[str, Any]:
        return {cause: messages for cause, (messages, _) in amounts(self.losses.report()).items()}


def frame(*components: list[float]) -> Frame:
    """Return a frame with one component of tools for each list of positions in mm."""
    return split_frame(encode_frame([tools_component(xs) for xs in components], "big"), "big")


def poses(*xs_m: float) -> bytes:
    """Return the poses of the first trackers."""
    return b"".join(
        encode_pose(number, UTIME, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for number, x in enumerate(xs_m)
    )


def test_tools_have_trackers_from_the_parameters_or_from_their_frames() -> None:
    """They are described to clients when they are new, and only then."""
    lab = Lab()
    lab.publisher.set_parameters(parameters(["wand"]))
    lab.run()
    assert (list(lab.server.trackers.of_source("lab")), lab.server.num_described) == (["wand"], 1)
    lab.send([1000.0])
    lab.send([2000.0, 3000.0])
    lab.send([1000.0])
    assert lab.server.sent == [poses(1.0), poses(2.0, 3.0), poses(1.0)]
    assert lab.server.num_described == 2
    lab.is_full = True
    lab.publisher.set_parameters(parameters(["cup", "pan"], 2))  # the next frame names the trackers
    lab.is_full = False
    lab.send([1000.0])
    assert list(lab.server.trackers.of_source("lab")) == ["cup", "pan"]
    lab.publisher.close()
    lab.run()
    assert not lab.server.trackers.of_source("lab")


def test_tools_beyond_the_limit_are_counted_and_not_sent() -> None:
    """Over all components of a frame."""
    lab = Lab()
    lab.publisher.set_parameters(parameters([]))
    lab.send([0.0] * MAX_TOOLS)
    assert lab.lost == {}
    size = len(lab.server.sent[0]) // MAX_TOOLS
    lab.send([0.0] * (MAX_TOOLS + 3))
    assert (lab.lost, len(lab.server.sent[1])) == ({"too many tools": 3}, MAX_TOOLS * size)
    lab.send([0.0] * 200, [0.0] * 50, [0.0] * 100)
    assert (lab.lost, len(lab.server.sent[2])) == ({"too many tools": 3 + 94}, MAX_TOOLS * size)


def test_each_client_that_misses_poses_counts() -> None:
    """Two poses for three clients are six."""
    lab = Lab()
    lab.publisher.set_parameters(parameters(["wand", "cup"]))
    lab.server.slow = ["a", "b", "c"]
    lab.send([1.0, 2.0])
    assert lab.lost == {"slow client": 6}


def test_frames_are_handed_over_while_a_client_is_connected() -> None:
    """What cannot be sent is refused with its cause."""
    lab, one = Lab(), frame([1000.0])
    lab.server.has_clients = False
    lab.publisher.publish(one, stamp(UTIME), 0, TOOLS)
    assert (lab.publisher.wants(TOOLS), lab.calls) == (False, [])
    lab.server.has_clients = True
    assert lab.publisher.prepare(one.layout, TOOLS)
    assert not lab.publisher.prepare(one.layout, frozenset({ComponentType.MARKERS}))
    assert not lab.publisher.prepare(frame([]).layout, TOOLS)
    for given, cause in ((parameters([]), "queue full"), (parameters([], unit_m=None), "unknown unit")):
        lab.is_full = False
        lab.publisher.set_parameters(given)
        if cause == "queue full":
            lab.publisher.publish(one, stamp(UTIME), 0, TOOLS)
            assert lab.calls[-1][1] == len(one.body)
            lab.is_full = True
        with pytest.raises(OutputError) as refused:
            lab.publisher.publish(one, stamp(UTIME), 0, TOOLS)
        assert refused.value.cause == cause
