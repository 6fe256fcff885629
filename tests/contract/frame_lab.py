"""The outputs that take whole frames, each with the sources of a gateway and a real peer.

The sources are published by the gateway's own FanOut, so what an output refuses is counted as in the gateway.
"""

import asyncio
import importlib
import importlib.util
import itertools
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from typing import Any, Final

import pytest

from gateway.errors import OutputError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.encode import Stamp
from gateway.outputs.contract import FramePublisher, Output
from gateway.outputs.registry import OUTPUTS
from gateway.publish.fan_out import FanOut
from gateway.rtc3d.components import WIRE_ORDER
from gateway.rtc3d.frames import RawFrame
from gateway.rtc3d.parameters import Parameters
from gateway.runtime.workers import make_call
from tests.contract.frame_rigs import (
    ALL,
    LAB,
    SOURCES,
    FrameRig,
    NoQueries,
    frame,
    labelled,
    server_parameters,
    stamp,
)
from tests.support.statuses import amounts
from tests.support.waiting import wait_until_async

RETURNS_WITHIN_S: Final = 60.0
MAINTENANCE_S: Final = 0.1
"""The gateway calls ``maintain`` once a second."""


def _rig_of(name: str) -> type[FrameRig] | None:
    module = f"tests.contract.{name}_rig"
    if importlib.util.find_spec(module) is None:
        return None
    rig: type[FrameRig] = importlib.import_module(module).Rig
    return rig


RIGS: Final = {name: rig for name in OUTPUTS if (rig := _rig_of(name)) is not None}
"""The rig of each output that takes whole frames."""


def rigs(
    is_chosen: Callable[[type[FrameRig]], bool] = lambda _: True, *, are_real: bool = False
) -> pytest.MarkDecorator:
    """Run a test with the rigs for which ``is_chosen``; light ones replace others unless ``are_real``."""
    chosen = [
        pytest.param(rig if are_real else rig.light or rig, id=name)
        for name, rig in RIGS.items()
        if is_chosen(rig)
    ]
    return pytest.mark.parametrize("lab", chosen, indirect=True)


every_rig = rigs()
every_real_rig = rigs(are_real=True)
can_be_cut = rigs(lambda rig: rig.listens or rig.has_router)
has_router = rigs(lambda rig: rig.has_router)
listens = rigs(lambda rig: rig.listens)
converts = rigs(lambda rig: rig.converts)


class Lab:
    """A rig, and the sources of a gateway that publishes on its output."""

    def __init__(self, rig: FrameRig) -> None:
        self.rig = rig
        self.output = rig.output
        self.fan_outs: dict[str, FanOut] = {}
        self._numbers = itertools.count(1)
        self._outputs = [self.output]
        self.output.serve_queries(NoQueries())

    def replace_output(self) -> Output:
        """Close the output, and use a new one with the same settings."""
        self.output = self.rig.output = self.rig.create()
        self.output.serve_queries(NoQueries())
        self._outputs.append(self.output)
        return self.output

    def serve(self, *sources: str) -> None:
        """Publish these sources, with the parameters of a small laboratory; none means all."""
        for source in sources or SOURCES:
            self.fan_outs[source] = FanOut(source, [self.output])
            self.set_parameters(source, labelled())

    def set_parameters(
        self, source: str, parsed: Parameters, version: int = 1, frame: CoordinateFrame | None = None
    ) -> None:
        self.output.publish_parameters(source, server_parameters(parsed, version, frame))

    async def open(self) -> None:
        """Start the output, and wait until it is open."""
        self.output.start()
        await wait_until_async(lambda: self.output.health().connected)

    async def start(self) -> None:
        """Open the output, publish all sources, and connect a peer that receives them."""
        self.serve()
        await self.open()
        await self.subscribe()

    async def subscribe(self) -> None:
        """Connect a peer, and wait until it receives every source that is published."""
        await asyncio.to_thread(self.rig.subscribe)
        for source in self.fan_outs:
            await self.arrives(source)

    def publish(self, source: str, to_publish: RawFrame, at: Stamp | None = None) -> None:
        self.fan_outs[source].publish(to_publish, at or stamp(), ALL)

    def publish_next(self, source: str = LAB) -> int:
        """Publish a frame with all components; return its number."""
        number = next(self._numbers)
        self.publish(source, frame(number))
        return number

    async def arrives(self, source: str = LAB) -> None:
        """Publish frames until one of them arrives."""
        sent = []

        def has_arrived() -> bool:
            sent.append(self.publish_next(source) / 1000)
            return any(x in sent for x in self.xs(source))

        await wait_until_async(has_arrived)

    async def arrives_next(self, source: str = LAB) -> None:
        """Publish a frame, and wait until it arrives."""
        x = self.publish_next(source) / 1000
        await wait_until_async(lambda: x in self.xs(source))

    def xs(self, source: str = LAB) -> list[float]:
        """Return what has arrived of a source, rounded to µm."""
        return [round(x, 6) for each, x in list(self.rig.received) if each == source]

    def lost(self, source: str = LAB) -> dict[str, int]:
        """Return how many messages of a source were lost, by cause."""
        [(_, status)] = self.fan_outs[source].outputs
        return {cause: messages for cause, (messages, _) in amounts(status.losses).items()}

    def sent(self, source: str = LAB) -> Mapping[str, int]:
        """Return how many messages of a source count as sent."""
        [(_, status)] = self.fan_outs[source].outputs
        return status.messages

    def wanted(self, source: str = LAB) -> bool:
        return self.fan_outs[source].has_subscribers(WIRE_ORDER)

    async def maintain(self) -> None:
        """Do what the gateway does once a second."""
        while True:
            for output in self._outputs:
                output.maintain()
            await asyncio.sleep(MAINTENANCE_S)

    async def close(self) -> None:
        for fan_out in self.fan_outs.values():
            fan_out.close()
        for output in self._outputs:
            await output.stop_queries()
            await asyncio.to_thread(output.close)
        await asyncio.to_thread(self.rig.close)


@pytest.fixture
async def lab(request: pytest.FixtureRequest, caplog: pytest.LogCaptureFixture) -> AsyncIterator[Lab]:
    """Run a test with a rig; no defect may be logged, in whatever thread it is noticed."""
    lab = Lab(request.param())
    maintenance = asyncio.create_task(lab.maintain())
    try:
        yield lab
    finally:
        maintenance.cancel()
        await lab.close()
    defects = [
        record.getMessage() for record in caplog.records if record.exc_info or record.levelname == "ERROR"
    ]
    assert not defects


async def returns(call: Callable[[], Any]) -> None:
    """Make a call in a thread that nobody has to wait for; fail if it does not return."""
    made: Future[None] = Future()
    threading.Thread(target=make_call, args=(made, call), daemon=True).start()
    await wait_until_async(made.done, RETURNS_WITHIN_S)
    made.result()


def offered(publisher: FramePublisher, to_publish: RawFrame) -> str:
    """Publish a frame; return the cause if it is refused, "" otherwise."""
    try:
        publisher.publish(to_publish, stamp(), ALL)
    except OutputError as error:
        return error.cause if str(error) else "an error without a text"
    return ""


def names_remedy(lab: Lab) -> bool:
    health = lab.output.health()
    return not health.connected and any(remedy in health.problem for remedy in lab.rig.remedies)
