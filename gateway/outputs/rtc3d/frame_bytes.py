"""The bytes of frames for clients, cut from the frames that arrived."""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from gateway.outputs.rtc3d.arrivals import Arrival
from gateway.rtc3d.components import (
    WIRE_ORDER,
    ByteOrder,
    Component,
    ComponentType,
    Items,
    encode_component,
)
from gateway.rtc3d.frames import Frame, encode_frame

_HEADER_BYTES: Final = 8  # size and type, before a component's content


class Events(NamedTuple):
    """The event components of a frame that arrived at ``time_us``."""

    time_us: int
    components: tuple[Component, ...]

    @property
    def num_bytes(self) -> int:
        """The size of the components."""
        return sum(len(component.content) for component in self.components)


def events_of(arrival: Arrival) -> Events:
    """Return the events of a frame."""
    frame = arrival.frame
    return Events(
        arrival.time_us,
        tuple(
            frame.component(index)
            for index, component in enumerate(frame.layout.components)
            if component.type is ComponentType.EVENT
        ),
    )


def unchanged_body(
    arrival: Arrival, chosen: frozenset[ComponentType], byte_order: ByteOrder, *, takes_all: bool
) -> bytes | None:
    """Return the body as it arrived; None if it has another byte order, or more than the chosen components.

    Components of unknown type are part of all components, but of no choice of some.
    """
    frame, composition = arrival.frame, arrival.composition
    is_chosen = composition.measured <= chosen and (
        not composition.has_events or ComponentType.EVENT in chosen
    )
    has_others = bool(frame.layout.unknown_types) and not takes_all
    if frame.layout.byte_order != byte_order or not composition.is_complete or not is_chosen or has_others:
        return None
    return frame.body


def encode_joined(
    arrivals: Iterable[Arrival],
    chosen: frozenset[ComponentType],
    events: Sequence[bytes],
    byte_order: ByteOrder,
) -> bytes:
    """Return a body with the ``chosen`` components of several frames, each as it came, and with ``events``.

    If two frames have the same component, the first frame counts.
    """
    found: dict[ComponentType, tuple[Frame, list[int]]] = {}
    for arrival in arrivals:
        frame = arrival.frame
        indices: dict[ComponentType, list[int]] = {}
        for index, component in enumerate(frame.layout.components):
            if component.type in chosen and component.type in arrival.composition.measured:
                indices.setdefault(component.type, []).append(index)
        for component_type, its_indices in indices.items():
            found.setdefault(component_type, (frame, its_indices))
    parts = [
        _component_bytes(frame, index, byte_order)
        for component_type in WIRE_ORDER
        if component_type in found
        for frame, indices_of_type in [found[component_type]]
        for index in indices_of_type
    ]
    return encode_frame([*parts, *events], byte_order)


def _component_bytes(frame: Frame, index: int, byte_order: ByteOrder) -> bytes:
    if frame.layout.byte_order == byte_order:
        start, end = frame.layout.content_spans[index]
        return frame.body[start - _HEADER_BYTES : end]
    return _encoded(frame.component(index), byte_order)


def _encoded(component: Component, byte_order: ByteOrder) -> bytes:
    return encode_component(
        component.type, component.frame_number, component.timestamp_us, component.items(), byte_order
    )


def _in_order(component: Component, byte_order: ByteOrder) -> Items:
    items = component.items()
    return items.astype(items.dtype.newbyteorder(byte_order), copy=False)


def encode_events(events: Sequence[Events], main: Arrival, byte_order: ByteOrder) -> list[bytes]:
    """Return the event components of a frame: those of ``main`` as they came, if there are no others.

    Otherwise all events become one component for each size of events, as a server sends them at a low rate:
    with the time stamp of the frame.
    """
    components = [component for each in events for component in each.components]
    if all(each.time_us == main.time_us for each in events):
        return [_encoded(component, byte_order) for component in components]
    by_size: dict[int, list[Component]] = {}
    for component in components:
        by_size.setdefault(component.item_bytes, []).append(component)
    frame_number, timestamp_us = main.frame.number_and_timestamp
    return [
        encode_component(
            ComponentType.EVENT,
            frame_number,
            timestamp_us,
            np.concatenate([_in_order(component, byte_order) for component in same_size]),
            byte_order,
        )
        for same_size in by_size.values()
    ]
