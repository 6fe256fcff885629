"""Outputs that take whole frames, each with the network around it and a real peer.

The rig of the output NAME is the class ``Rig`` of the module NAME_rig.py beside this one. All tests of
frames, test_frame_*.py, then run with it. Every number that the tests send is the x position of the only
tool in view, so a rig has to recognise nothing else in what its peer receives.
"""

import contextlib
import math
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

import numpy as np

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.contract import Answer, KeyPath, Output, ServerParameters
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    MISSING,
    SHORT_EVENT,
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
from gateway.rtc3d.parameters_xml import encode_parameters

LAB: Final = "lab"
HALL: Final = "hall-2"
SOURCES: Final = (LAB, HALL)
"""The sources of every test. An output with a port for each source has to serve both."""

ALL: Final = frozenset(WIRE_ORDER)

Received = tuple[str, float]
"""A source, and the position of a tool along x in metres, as a peer received it."""


class FrameRig(ABC):
    """An output of whole frames, which is not started, and the network around it, which works at first.

    Its methods may block: the tests call them in threads, one at a time.
    """

    remedies: ClassVar[tuple[str, ...]] = ()
    """While the network is down, the problem in ``health`` contains one of these texts."""

    tcp_port: int | None = None
    """Where the output listens for TCP connections; None if it does not."""

    udp_port: int | None = None
    """Where the output listens for UDP datagrams; None if it does not."""

    listens: ClassVar[bool] = False
    """Whether the output has a port of its own, which others may have taken."""

    has_router: ClassVar[bool] = False
    """Whether the output needs a router, which may come and go."""

    converts: ClassVar[bool] = True
    """Whether peers get poses in metres and in the source's frame, not what the server sent."""

    light: "ClassVar[type[FrameRig] | None]" = None
    """A rig without processes for tests that look at frames and states, not at the network; None for this."""

    output: Output

    @abstractmethod
    def create(self) -> Output:
        """Return a further output with the settings of ``output``, not started."""

    _received: list[Received]

    @property
    def received(self) -> list[Received]:
        """The positions of tools in view that the peers of ``subscribe`` received so far, oldest first."""
        return self._received

    @abstractmethod
    def subscribe(self) -> None:
        """Connect a further peer, which receives what it can of both sources."""

    @abstractmethod
    def unsubscribe(self) -> None:
        """Disconnect all peers."""

    @abstractmethod
    def stall(self) -> None:
        """Connect a peer that asks for everything and then never reads."""

    def cut(self) -> None:
        """Make the output unable to open: take its port, or stop its router."""
        raise NotImplementedError

    def restore(self) -> None:
        """Undo ``cut``; the output has to notice by itself."""
        raise NotImplementedError

    @abstractmethod
    def close(self) -> None:
        """Close the peers and the network. ``output`` is closed already."""


class ListeningRig(FrameRig):
    """An output with a port of its own, which another program takes at ``cut``.

    The sockets in ``clients`` are closed with the peers.
    """

    listens = True

    def __init__(self, port: int) -> None:
        self.tcp_port = port
        self._received: list[Received] = []
        self.clients: list[socket.socket] = []
        self._other_program: socket.socket | None = None
        self.output = self.create()

    def unsubscribe(self) -> None:
        while self.clients:
            client = self.clients.pop()
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()

    def cut(self) -> None:
        assert self.tcp_port is not None
        self._other_program = socket.create_server(("127.0.0.1", self.tcp_port))

    def restore(self) -> None:
        assert self._other_program is not None
        self._other_program.close()

    def close(self) -> None:
        self.unsubscribe()
        if self._other_program is not None:
            self._other_program.close()


class NoQueries:
    """A query service that knows the sources and answers nothing."""

    def serves(self, source: str) -> bool:
        return source in SOURCES

    def server(self, _source: str) -> str:
        return "192.0.2.20:3020"

    def keys(self, _source: str) -> list[KeyPath]:
        return []

    def commands(self) -> Sequence[str]:
        return ()

    def accepted_keys(self, _source: str) -> str:
        return "none"

    async def answer(self, _source: str, _path: KeyPath, _options: Mapping[str, str]) -> Answer:
        raise QueryError("nothing yet", code="nothing-yet")

    async def answer_all(
        self, _source: str, _paths: Sequence[KeyPath], _options: Mapping[str, str]
    ) -> dict[KeyPath, Answer]:
        raise QueryError("nothing yet", code="nothing-yet")

    async def parameters(self, _source: str, _sections: Sequence[str], *, fresh: bool) -> ServerParameters:
        del fresh
        raise QueryError("nothing yet", code="nothing-yet")


# What is sent ----------------------------------------------------------------------------------


def labelled(
    *, markers: Sequence[str] = ("C7", "LASI", "RASI"), tools: Sequence[str] = ("Probe 1", "Left Foot")
) -> Parameters:
    """Return parameters with these labels, four analog channels, a plate and a kind of event."""
    return Parameters(
        markers=Parameters3D(200.0, "mm", tuple(Marker(str(at), each) for at, each in enumerate(markers))),
        tools=Parameters6D(200.0, tuple(Tool(str(at), each) for at, each in enumerate(tools))),
        analog=ParametersAnalog(tuple(AnalogChannel(str(at), f"EMG {at}") for at in range(4))),
        force=ParametersForce((Plate("1", "First force plate"),)),
        events=ParametersEvents((EventDefinition("7", "Button"),)),
    )


def server_parameters(
    parsed: Parameters, version: int = 1, frame: CoordinateFrame | None = None
) -> ServerParameters:
    """Return the parameters of a server whose unit of length is mm, unless ``frame`` has another."""
    return ServerParameters(
        encode_parameters(parsed), session=1, version=version, parsed=parsed, frame=frame or world()
    )


def world(metres_per_unit: float | None = 1e-3, *, turned: bool = False, x_m: float = 0.0) -> CoordinateFrame:
    """Return a frame, ``turned`` by half a turn around z if so, and then moved by ``x_m`` along x."""
    rotation = (0.0, 0.0, 1.0, 0.0) if turned else (0.0, 0.0, 0.0, 1.0)
    return CoordinateFrame("world", metres_per_unit, rotation, (x_m, 0.0, 0.0))


def tools(*xs: float) -> np.ndarray[Any, Any]:
    """Return tools at these positions, without a rotation; NaN is out of view."""
    items = np.zeros(len(xs), ITEM_DTYPES[ComponentType.TOOLS])
    for at, x in enumerate(xs):
        items[at] = (MISSING,) * 8 if math.isnan(x) else (1, 0, 0, 0, x, 20, 30, 0.1)
    return items


def component(
    number: int, kind: ComponentType, items: np.ndarray[Any, Any] | None = None, order: ByteOrder = "big"
) -> bytes:
    """Return a component of the frame ``number``; without ``items``, one as a small laboratory has."""
    if items is None:
        sizes = {ComponentType.MARKERS: 3, ComponentType.ANALOG: 4, ComponentType.FORCE: 1}
        items = np.zeros(sizes.get(kind, 0), ITEM_DTYPES[kind])
        if kind is ComponentType.TOOLS:
            items = tools(number, math.nan)
        elif kind is ComponentType.EVENT:
            items = np.array([(7, number * 5000, 1, 2, 3)], ITEM_DTYPES[kind])
    return encode_component(kind, number, number * 5000, items, order)


def frame_of(*components: bytes, order: ByteOrder = "big") -> RawFrame:
    """Return a frame with these components."""
    return split_frame(encode_frame(components, order), order)


def frame(number: int, order: ByteOrder = "big") -> RawFrame:
    """Return a frame with all five components."""
    return frame_of(*(component(number, kind, order=order) for kind in WIRE_ORDER), order=order)


def odd_frames(number: int) -> dict[str, RawFrame]:
    """Return frames that lack or repeat components, each with the tool at ``number`` if it has one."""
    tool = component(number, ComponentType.TOOLS)
    short_event = np.array([(7, 1, 2, 3)], SHORT_EVENT)
    nothing = {kind: component(number, kind, np.zeros(0, ITEM_DTYPES[kind])) for kind in WIRE_ORDER}
    return {
        "nothing": frame_of(),
        "an unknown component": frame_of(bytes([0, 0, 0, 12, 0, 0, 0, 99, 1, 2, 3, 4])),
        "only markers": frame_of(component(number, ComponentType.MARKERS)),
        "only tools": frame_of(tool),
        "only an event of 16 bytes": frame_of(component(number, ComponentType.EVENT, short_event)),
        "analog and force": frame_of(
            *(component(number, k) for k in (ComponentType.ANALOG, ComponentType.FORCE))
        ),
        "everything twice": frame_of(*(component(number, kind) for kind in (*WIRE_ORDER, *WIRE_ORDER))),
        "tools in 60 components": frame_of(*[tool] * 60),
        "components without items": frame_of(*nothing.values()),
        "little-endian": frame(number, "little"),
        "more items than labels": frame_of(
            component(number, ComponentType.MARKERS, np.zeros(9, ITEM_DTYPES[ComponentType.MARKERS])),
            component(number, ComponentType.TOOLS, tools(number, *[math.nan] * 8)),
            component(number, ComponentType.ANALOG, np.zeros(69, ITEM_DTYPES[ComponentType.ANALOG])),
            component(number, ComponentType.FORCE, np.zeros(5, ITEM_DTYPES[ComponentType.FORCE])),
        ),
        "infinite and missing": frame_of(
            component(number, ComponentType.TOOLS, tools(math.nan, math.nan)),
            component(
                number,
                ComponentType.ANALOG,
                np.array([math.inf, -math.inf, math.nan, 1e38], ITEM_DTYPES[ComponentType.ANALOG]),
            ),
        ),
    }


def stamp(version: int = 1) -> Stamp:
    """Return the stamp of a frame that has just arrived."""
    now_us = time.time_ns() // 1000
    return Stamp(now_us, now_us - 2000, session=1, parameters_version=version)
