"""Components as the gateway receives them, made from the test vectors."""

from gateway.rtc3d.components import Component
from gateway.rtc3d.frames import split_frame
from tests.vectors import ByteOrder, ComponentVector


def received(vector: ComponentVector, order: ByteOrder = "big") -> Component:
    """Return the vector's component, split from a frame in this byte order."""
    (component,) = split_frame((1).to_bytes(4, order) + vector.wire[order], order).components
    return component
