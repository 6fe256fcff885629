"""A simulator's clients, connected to it directly or through a gateway: both must get the same."""

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any

from gateway.config.settings import StreamSettings
from gateway.rtc3d.components import ComponentType
from gateway.simulator.simulator import Simulator
from tests.integration.raw_client import Listening
from tests.serving_gateway import serving_gateway

Served = Callable[..., AbstractAsyncContextManager[Listening]]
"""Takes a simulator; yields the server that clients connect to."""

_FAST = (ComponentType.ANALOG, ComponentType.FORCE)

_TWO_STREAMS = (
    StreamSettings(components=tuple(each for each in ComponentType if each not in _FAST)),
    StreamSettings(components=_FAST),
)
"""The parameters of a CountingScene do not announce the rate of its analog channels."""


@asynccontextmanager
async def directly(simulator: Simulator, **_: Any) -> AsyncIterator[Listening]:
    yield simulator


@asynccontextmanager
async def through_a_gateway(simulator: Simulator, *, is_streaming: bool = True) -> AsyncIterator[Listening]:
    async with serving_gateway(simulator, is_streaming=is_streaming, streams=_TWO_STREAMS) as gateway:
        yield gateway
