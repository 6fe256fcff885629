"""Packets for faults to change, and helpers that return the changed ones."""

import struct

import numpy as np

from gateway.simulator.faults.base import ActiveFault, Fault, LastingConnectionFault
from gateway.simulator.faults.outgoing import PendingWrite
from gateway.simulator.simulator import Simulator
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    DATA,
    MARKERS,
    ByteOrder,
    WireComponent,
    components_in,
    packet,
    packets_in,
)


def active(fault: Fault, seed: int = 1) -> ActiveFault:
    return ActiveFault(fault, Simulator(CountingScene()).faults, np.random.default_rng(seed))


def markers(
    byte_order: ByteOrder = "big", count: int = 2, number: int = 7, timestamp_us: int = 9000
) -> bytes:
    """Return a 3D component; marker k is at (k, 1.5, -2) with the residual 0.25."""
    sign = ">" if byte_order == "big" else "<"
    items = b"".join(struct.pack(sign + "4f", k, 1.5, -2.0, 0.25) for k in range(count))
    return struct.pack(sign + "IIiqI", 24 + len(items), MARKERS, number, timestamp_us, count) + items


def frame(*components: bytes, byte_order: ByteOrder = "big") -> bytes:
    sign = ">" if byte_order == "big" else "<"
    return packet(DATA, struct.pack(sign + "I", len(components)) + b"".join(components))


def writes_for(
    fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None
) -> list[PendingWrite]:
    """Return what is written instead of one packet that is due at 100 s."""
    return fault.change_writes([PendingWrite(100.0, packet)], active_fault or active(fault))


def changed(fault: LastingConnectionFault, packet: bytes, active_fault: ActiveFault | None = None) -> bytes:
    [write] = writes_for(fault, packet, active_fault)
    assert (write.due_s, write.joins_previous) == (100.0, False)
    return write.data


def components_in_packet(
    data: bytes, byte_order: ByteOrder = "big", event_bytes: int = 24
) -> list[WireComponent]:
    [(packet_type, body)] = packets_in(data)
    assert packet_type == DATA
    return components_in(body, byte_order, event_bytes=event_bytes)
