"""An output for ROS 2, the router that it connects to, and a subscriber that hears everything."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.ros2.output import Ros2Output
from gateway.outputs.adapters.ros2.settings import Ros2Settings
from gateway.outputs.contract import FramePublisher, ServerParameters
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    MISSING,
    WIRE_ORDER,
    ByteOrder,
    ComponentType,
    encode_component,
)
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    ParametersForce,
    Plate,
    Tool,
)
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.waiting import wait_until

ALL = frozenset(WIRE_ORDER)
UTIME = 1_700_000_000_000_001
ONE_TOOL = (ComponentType.TOOLS, [(1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0)])


def parameters(
    tools: tuple[str, ...] = (),
    *,
    markers: int = 0,
    channels: tuple[str, ...] = (),
    plates: tuple[Plate, ...] = (),
    events: tuple[EventDefinition, ...] = (),
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
        events=ParametersEvents(events),
    )
    return ServerParameters(b"<xml/>", 1, version, parsed=parsed, frame=frame or CoordinateFrame("lab"))


def frame_of(*components: tuple[ComponentType, list[Any]], byte_order: ByteOrder = "big") -> RawFrame:
    """Return a frame; items are tuples of the component's fields, None is a missing tool or marker."""
    encoded = []
    for kind, items in components:
        dtype = ITEM_DTYPES[kind]
        missing = tuple([MISSING] * len(dtype.names or ()))
        array = np.array([missing if item is None else item for item in items], dtype)
        encoded.append(encode_component(kind, 7, 1000, array, byte_order))
    return split_frame(encode_frame(encoded, byte_order), byte_order)


def tools_frame(*positions: tuple[float, float, float] | None, byte_order: ByteOrder = "big") -> RawFrame:
    """Return a frame of tools without rotation."""
    items = [None if each is None else (1.0, 0.0, 0.0, 0.0, *each, 0.1) for each in positions]
    return frame_of((ComponentType.TOOLS, items), byte_order=byte_order)


def stamp(utime: int = UTIME) -> Stamp:
    return Stamp(utime + 500, utime, 1, 1)


class RosLab:
    """A router, and the output after ``open`` with the source "lab"."""

    def __init__(self, **settings: Any) -> None:
        self.endpoint = free_endpoint()
        self.router = open_zenoh("router", listen=self.endpoint)
        self.settings = Ros2Settings(enabled=True, connect=self.endpoint, **settings)
        self.output = Ros2Output(self.settings)
        self.peer = open_zenoh("client", connect=self.endpoint)

    def open(self) -> None:
        self.output.start()
        wait_until(self._is_connected)

    def _is_connected(self) -> bool:
        self.output.maintain()
        return self.output.health().connected

    def source(self, given: ServerParameters | None = None) -> FramePublisher:
        """Announce the source "lab" as the gateway does."""
        publisher = self.output.frame_publisher("lab")
        self.output.announce("lab")
        if given is not None:
            self.output.publish_parameters("lab", given)
        return publisher

    def tokens(self) -> set[str]:
        replies = self.peer.liveliness().get("@ros2_lv/**")
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


@contextmanager
def ros_lab(**settings: Any) -> Iterator[RosLab]:
    lab = RosLab(**settings)
    try:
        yield lab
    finally:
        lab.output.close()
        lab.peer.close()
        lab.router.close()
