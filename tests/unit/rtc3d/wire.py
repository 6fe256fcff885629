"""Frames built without the encoder under test."""

import pytest

from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from tests.vectors import COMPONENTS, EMPTY_FRAME, FRAME_WITH_UNKNOWN, FULL_FRAME, ByteOrder

both_orders = pytest.mark.parametrize("order", ["big", "little"])
each_component = pytest.mark.parametrize("vector", COMPONENTS, ids=[vector.name for vector in COMPONENTS])
bodies_of_both_orders = pytest.mark.parametrize(
    ("body", "order"),
    [
        (frames[order], order)
        for frames in (FULL_FRAME, FRAME_WITH_UNKNOWN, EMPTY_FRAME)
        for order in ("big", "little")
    ],
)


def frame(order: ByteOrder, *components: bytes, count: int | None = None) -> bytes:
    """Return a frame's bytes. ``count`` replaces its component count with a wrong one."""
    return (len(components) if count is None else count).to_bytes(4, order) + b"".join(components)


def only_component(body: bytes, order: ByteOrder) -> Component:
    (component,) = split_frame(body, order).components
    return component
