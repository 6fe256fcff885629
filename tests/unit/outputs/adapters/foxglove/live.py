"""An output with viewers, and a source that publishes on it as in the gateway."""

import math
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, Final, TypeVar

import numpy as np

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.adapters.foxglove.output import FoxgloveOutput
from gateway.outputs.adapters.foxglove.settings import FoxgloveSettings
from gateway.outputs.contract import ServerParameters
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, WIRE_ORDER, ByteOrder, ComponentType, encode_component
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.rtc3d.parameters import AnalogChannel, Parameters, ParametersAnalog, Plate, Point
from tests.support.foxglove_viewer import Viewer, viewing
from tests.support.networks import free_port
from tests.support.statuses import amounts
from tests.support.waiting import wait_until_async

_Result = TypeVar("_Result")

UTIME: Final = 1_700_000_000_000_000
MARKERS, TOOLS, ANALOG, FORCE, EVENT = WIRE_ORDER
_CORNERS: Final = ((600.0, 400.0), (0.0, 400.0), (0.0, 0.0), (600.0, 0.0))
PLATE: Final = Plate("1", "left", corners=tuple(Point(x, y, 0.0, "mm") for x, y in _CORNERS))
QUARTER_TURN: Final = CoordinateFrame(
    "hall", 1e-3, (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)), (10.0, 0.0, 0.0)
)
"""Turns x to y, and then moves 10 m along x."""
ITEMS: Final[Mapping[ComponentType, list[Any]]] = {
    MARKERS: [(1, 2, 3, 0)],
    TOOLS: [(1, 0, 0, 0, 1, 2, 3, 0.1)],
    ANALOG: [1],
    FORCE: [(1, 2, 3, 4, 5, 6)],
    EVENT: [(7, 0, 1, 2, 3)],
}
"""One of each component."""


def frame_of(
    items: Mapping[ComponentType, Iterable[Any]], order: ByteOrder = "big", timestamp_us: int = 0
) -> RawFrame:
    """Return a frame with these components."""
    encoded = [
        encode_component(kind, 1, timestamp_us, np.array(list(each), ITEM_DTYPES[kind]), order)
        for kind, each in items.items()
    ]
    return split_frame(encode_frame(encoded, order), order)


def channels(*labels: str) -> Parameters:
    """Return parameters with these analog channels."""
    described = tuple(AnalogChannel(str(number), label) for number, label in enumerate(labels))
    return Parameters(analog=ParametersAnalog(described))


class LiveSource:
    """A source that publishes on ``output``."""

    def __init__(self, name: str, output: FoxgloveOutput) -> None:
        self.name = name
        self.output = output
        self.fan_out = FanOut(name, [output])

    def set_parameters(
        self, parsed: Parameters, version: int = 1, frame: CoordinateFrame | None = None
    ) -> None:
        frame = frame or CoordinateFrame(self.name)
        described = ServerParameters(b"<xml/>", 1, version, parsed=parsed, frame=frame)
        self.output.publish_parameters(self.name, described)

    def publish(self, frame: RawFrame, utime: int = UTIME) -> None:
        self.fan_out.publish(frame, Stamp(utime, utime, 1, 1), frozenset(WIRE_ORDER))

    def publish_items(
        self, kind: ComponentType, items: Iterable[Any] | None = None, utime: int = UTIME
    ) -> None:
        self.publish(frame_of({kind: ITEMS[kind] if items is None else items}), utime)

    async def publish_until(self, frame: RawFrame, condition: Callable[[], _Result]) -> _Result:
        """Publish a frame again and again until a condition holds; return its result."""

        def is_true() -> bool:
            self.publish(frame)
            return bool(condition())

        await wait_until_async(is_true)
        return condition()

    @property
    def wanted(self) -> bool:
        return self.fan_out.has_subscribers(WIRE_ORDER)

    async def wait_until_wanted(self, wanted: bool = True) -> None:
        await wait_until_async(lambda: self.wanted is wanted)

    @property
    def losses(self) -> dict[str, tuple[int, int]]:
        """The (messages, frames) that were lost, by cause."""
        [(_, status)] = self.fan_out.outputs
        return amounts(status.losses)


@asynccontextmanager
async def serving(
    *names: str, settings: FoxgloveSettings | None = None
) -> AsyncIterator[tuple[int, list[LiveSource]]]:
    """Run an output with these sources, on a free port; yield its port and the sources."""
    port = free_port()
    settings = settings or FoxgloveSettings(enabled=True)
    output = FoxgloveOutput(settings.model_copy(update={"port": port}))
    output.start()
    try:
        await wait_until_async(lambda: output.health().connected)
        sources = [LiveSource(name, output) for name in names]
        yield port, sources
        for source in sources:
            source.fan_out.close()
    finally:
        output.close()


@asynccontextmanager
async def watching(*topics: str, given: Parameters | None = None) -> AsyncIterator[tuple[LiveSource, Viewer]]:
    """Run an output with the source lab, and a viewer; its topics are wanted, if it has any."""
    async with serving("lab") as (port, [lab]):
        if given is not None:
            lab.set_parameters(given)
        async with viewing(port, *topics) as viewer:
            if topics:
                await lab.wait_until_wanted()
            yield lab, viewer
