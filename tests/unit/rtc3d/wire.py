"""Frames put together by hand, and what the codec makes of them."""

from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from tests.vectors import ByteOrder


def frame(order: ByteOrder, *components: bytes, count: int | None = None) -> bytes:
    """Return a frame's bytes; ``count`` is what it announces, if not as many as it has."""
    return (len(components) if count is None else count).to_bytes(4, order) + b"".join(components)


def only_component(body: bytes, order: ByteOrder) -> Component:
    (component,) = split_frame(body, order).components
    return component
