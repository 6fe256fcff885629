"""Frames, stamps, parameters and outputs of whole frames for tests of what is published."""

from collections.abc import Callable, Collection

import numpy as np

from gateway.errors import OutputError
from gateway.messages.decode import decode
from gateway.messages.encode import Stamp
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, WIRE_ORDER, ComponentType, encode_component
from gateway.rtc3d.frames import FrameLayout, RawFrame, encode_frame, split_frame
from gateway.runtime.losses import Losses
from tests.support.toy_output import ToyOutput
from tests.support.vectors import FULL_FRAME

MARKERS, TOOLS, EVENT = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.EVENT
ALL = frozenset(WIRE_ORDER)
ONLY_MARKERS = frozenset({MARKERS})
FULL = split_frame(FULL_FRAME["big"], "big")
PERIOD_US = 10_000
UTIME = 1_700_000_000_000_000
STAMP = Stamp(utime=2_000, capture_utime=1_000, session=1, parameters_version=1)
NO_ROUTER = OutputError("no router is connected", cause="no router")


def frame(
    number: int, *types: ComponentType, num_items: int = 1, timestamp_us: int | None = None
) -> RawFrame:
    """Return frame ``number`` at 100 Hz, with items of each of these types; by default of 3D and 6D."""
    time_us = PERIOD_US * number if timestamp_us is None else timestamp_us
    components = [
        encode_component(
            each, number, time_us, np.zeros(num_items, LONG_EVENT if each is EVENT else ITEM_DTYPES[each])
        )
        for each in types or (MARKERS, TOOLS)
    ]
    return split_frame(encode_frame(components), "big")


def stamp(number: int) -> Stamp:
    return Stamp(UTIME + PERIOD_US * number, UTIME + PERIOD_US * number, 1, 1)


def publish(fan_out: FanOut, *numbers: int) -> None:
    """Publish 3D and 6D of the frames with these numbers."""
    for number in numbers:
        fan_out.publish(frame(number), stamp(number), ALL)


def publish_full(fan_out: FanOut, components: Collection[ComponentType] = ALL) -> None:
    """Publish a frame of all components."""
    fan_out.publish(FULL, STAMP, frozenset(components))


def numbered(output: ToyOutput, *path: str) -> list[tuple[int, int]]:
    """Return (sequence, frame number) of each message of a topic."""
    messages = [decode(data) for topic, data in output.messages if topic.path == path]
    return [(message.sequence, message.frame_number) for message in messages]


def sequences(output: ToyOutput, *path: str) -> list[int]:
    return [sequence for sequence, _ in numbered(output, *path)]


class FrameOutput(ToyOutput):
    """Takes whole frames, if they have one of the components in ``received``.

    ``frames`` are those that it accepted, ``prepared`` the layouts and components that it was asked for,
    ``closed`` counts closed publishers, and ``on_change`` is what it has to call when ``received`` changes.
    """

    def __init__(self, name: str = "toy") -> None:
        super().__init__(name)
        self.received = ALL
        self.prepared: list[tuple[FrameLayout, frozenset[ComponentType]]] = []
        self.on_change: Callable[[], None] = lambda: None
        self.frames: list[tuple[RawFrame, Stamp, frozenset[ComponentType]]] = []
        self.sources: list[str] = []
        self.closed = 0
        self.losses: dict[str, Losses] = {}

    def frame_publisher(self, source: str) -> "FrameOutputPublisher":
        self.sources.append(source)
        return FrameOutputPublisher(self)

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:  # noqa: ARG002 - one source
        self.on_change = on_change
        return True

    def count_losses(self, source: str, losses: Losses) -> None:
        self.losses[source] = losses


class FrameOutputPublisher:
    def __init__(self, output: FrameOutput) -> None:
        self._output = output

    def wants(self, components: Collection[ComponentType]) -> bool:
        return not self._output.received.isdisjoint(components)

    def prepare(self, layout: FrameLayout, components: frozenset[ComponentType]) -> bool:
        self._output.prepared.append((layout, components))
        if isinstance(self._output.error, ZeroDivisionError):
            raise self._output.error
        return not components.isdisjoint(self._output.received)

    def publish(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> None:
        if self._output.error is not None:
            raise self._output.error
        self._output.frames.append((frame, stamp, components))

    def close(self) -> None:
        self._output.closed += 1
