"""An output for ROS 2, the router that it connects to, and a subscriber that hears everything."""

import json
import logging
import struct
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import zenoh

from gateway.losses import Losses
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.stamp import Stamp
from gateway.outputs.contract import FramePublisher, ServerParameters
from gateway.outputs.ros2.output import Ros2Output
from gateway.outputs.ros2.settings import Ros2Settings
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    MISSING,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    encode_component,
)
from gateway.rtc3d.frames import Frame, encode_frame, split_frame
from gateway.rtc3d.parameters import (
    AnalogChannel,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Tool,
)
from tests.networks import free_endpoint, open_zenoh, zenoh_keys
from tests.unit.outputs.ros2 import ros_messages as ros
from tests.waiting import wait_until

ALL = frozenset(WIRE_ORDER)
UTIME = 1_700_000_000_000_001
STAMP = (1_700_000_000, 1000)
"""Seconds and nanoseconds of UTIME."""
ONE_TOOL = (ComponentType.TOOLS, [(1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0)])


class Received(NamedTuple):
    """A message as a ROS node gets it, and its attachment."""

    message: Any
    sequence: int
    source_time_ns: int
    gid: bytes


def parameters(
    tools: tuple[str, ...] = (),
    *,
    markers: int = 0,
    channels: tuple[str, ...] = (),
    plates: tuple[Plate, ...] = (),
    unit: str = "mm",
    version: int = 1,
    frame: CoordinateFrame | None = None,
) -> ServerParameters:
    parsed = Parameters(
        markers=Parameters3D(unit=unit, markers=tuple(Marker(str(n)) for n in range(markers))),
        tools=Parameters6D(tools=tuple(Tool(str(n), label) for n, label in enumerate(tools))),
        analog=ParametersAnalog(
            channels=tuple(AnalogChannel(str(n), label) for n, label in enumerate(channels))
        ),
        force=ParametersForce(plates=plates),
    )
    return ServerParameters(b"<xml/>", 1, version, parsed=parsed, frame=frame or CoordinateFrame("lab"))


def frame_of(*components: tuple[ComponentType, list[Any]], byte_order: ByteOrder = "big") -> Frame:
    """Return a frame; items are tuples of the component's fields, None is a missing tool or marker."""
    encoded = []
    for kind, items in components:
        dtype = ITEM_DTYPES[kind]
        missing = tuple([MISSING] * len(dtype.names or ()))
        array = np.array([missing if item is None else item for item in items], dtype)
        encoded.append(encode_component(kind, 7, 1000, array, byte_order))
    return split_frame(encode_frame(encoded, byte_order), byte_order)


def tools_frame(*positions: tuple[float, float, float] | None, byte_order: ByteOrder = "big") -> Frame:
    """Return a frame of tools without rotation."""
    items = [None if each is None else (1.0, 0.0, 0.0, 0.0, *each, 0.1) for each in positions]
    return frame_of((ComponentType.TOOLS, items), byte_order=byte_order)


def seconds(message: Any) -> tuple[int, int]:
    """Return the stamp of a message in seconds and nanoseconds."""
    return message.header.stamp.sec, message.header.stamp.nanosec


def stamp(utime: int = UTIME) -> Stamp:
    return Stamp(utime + 500, utime, 1, 1)


def _open_router(endpoint: str) -> zenoh.Session:
    """Open a router that drops nothing, although the subscriber takes long to decode hundreds of messages."""
    keys = zenoh_keys("router", listen=endpoint)
    keys["transport"]["link"] = {
        "tx": {"queue": {"congestion_control": {"drop": {"wait_before_drop": 10_000_000}}}}
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))


class RosLab:
    """The output, after ``open`` with the source "lab". ``received`` are the messages by topic."""

    def __init__(self, **settings: Any) -> None:
        self.endpoint = free_endpoint()
        self.router: zenoh.Session | None = _open_router(self.endpoint)
        self.settings = Ros2Settings(enabled=True, connect=self.endpoint, **settings)
        self.output = Ros2Output(self.settings)
        self.received: defaultdict[str, list[Received]] = defaultdict(list)
        self.keys: set[str] = set()
        self.losses: dict[str, Losses] = {}
        self._peer: zenoh.Session | None = None

    def open(self) -> "RosLab":
        self.output.start()
        wait_until(self.is_connected)
        return self

    def is_connected(self) -> bool:
        self.output.maintain()
        return self.output.health().connected

    @property
    def peer(self) -> zenoh.Session:
        if self._peer is None:
            self._peer = open_zenoh("client", connect=self.endpoint)
        return self._peer

    def source(self, name: str = "lab", given: ServerParameters | None = None) -> FramePublisher:
        """Announce a source as the gateway does."""
        publisher = self.output.frame_publisher(name)
        self.losses[name] = Losses(logging.getLogger("tests"), f"{name} to ros2")
        self.output.count_losses(name, self.losses[name])
        self.output.announce(name)
        if given is not None:
            self.output.publish_parameters(name, given)
        return publisher

    def hear_all(self) -> None:
        """Subscribe to all topics, and wait until those that are open know it."""
        self.settle()
        self.hear("**")
        sources = self.output._sources.values()
        wait_until(lambda: all(topic.wanted for each in sources for topic in each.topics.topics))
        wait_until(lambda: self.output._tf.wanted)

    def settle(self) -> None:
        """Wait until the sending thread has done what it was given so far."""
        done = threading.Event()
        assert self.output.offer(done.set)
        assert done.wait(10)

    def hear(self, topics: str) -> zenoh.Subscriber[None]:
        """Subscribe to topics, without their leading slash."""
        return self.peer.declare_subscriber(f"{self.settings.domain_id}/{topics}", self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        _, *topic, dds_type, _ = key.split("/")
        package, kind, _, name = dds_type.split("::")
        assert sample.attachment is not None
        sequence, source_time_ns, gid_bytes, gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
        assert gid_bytes == 16
        message = ros.decoded(sample.payload.to_bytes(), f"{package}/{kind}/{name[:-1]}")
        self.keys.add(key)
        self.received["/" + "/".join(topic)].append(Received(message, sequence, source_time_ns, gid))

    def tokens(self) -> set[str]:
        replies = self.peer.liveliness().get("@ros2_lv/**")
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def topics(self) -> set[str]:
        """Return the topics that ROS shows."""
        parts = [token.split("/") for token in self.tokens()]
        return {each[9].replace("%", "/") for each in parts if each[5] == "MP"}

    def lost(self, source: str = "lab") -> dict[str, int]:
        return {loss.cause: loss.messages for loss in self.losses[source].report()}

    def cut(self) -> None:
        assert self.router is not None
        self.router.close()
        self.router = None

    def restore(self) -> None:
        self.router = _open_router(self.endpoint)

    def close(self) -> None:
        self.output.close()
        if self._peer is not None:
            self._peer.close()
        if self.router is not None:
            self.router.close()


@contextmanager
def ros_lab(**settings: Any) -> Iterator[RosLab]:
    lab = RosLab(**settings)
    try:
        yield lab
    finally:
        lab.close()
