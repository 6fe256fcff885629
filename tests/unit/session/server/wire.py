"""RTC3D packets and frames, encoded and decoded with struct, following only the specification's tables."""

import struct
from typing import Literal, NamedTuple

ByteOrder = Literal["big", "little"]
ERROR, COMMAND, XML, DATA, NO_DATA = range(5)
MARKERS, ANALOG, FORCE, TOOLS, EVENT = range(1, 6)

_ITEMS = {MARKERS: "4f", ANALOG: "f", FORCE: "6f", TOOLS: "8f", EVENT: "iqiii"}
_SHORT_EVENT = "iiii"


class WireComponent(NamedTuple):
    """One component of a frame."""

    type: int
    frame_number: int
    timestamp_us: int
    items: list[tuple[float, ...]]


def packet(packet_type: int, body: bytes = b"") -> bytes:
    """Return a packet (§4.1): size of the whole packet, type, body."""
    return struct.pack(">II", 8 + len(body), packet_type) + body


def command(text: str) -> bytes:
    """Return a command as a packet of type 1 (§5.1)."""
    return packet(COMMAND, text.encode("ascii"))


def packets_in(stream: bytes) -> list[tuple[int, bytes]]:
    """Return the packets (type, body) in a byte stream, which must end with a complete packet."""
    packets = []
    while stream:
        size, packet_type = struct.unpack_from(">II", stream)
        assert 8 <= size <= len(stream), "half a packet"
        packets.append((packet_type, stream[8:size]))
        stream = stream[size:]
    return packets


def components_in(
    body: bytes, byte_order: ByteOrder = "big", *, event_bytes: int = 24
) -> list[WireComponent]:
    """Return the components of a data frame's body (§7.1); all sizes and counts must agree."""
    sign = ">" if byte_order == "big" else "<"
    (component_count,) = struct.unpack_from(sign + "I", body)
    start, components = 4, []
    for _ in range(component_count):
        size, kind, number, timestamp_us, count = struct.unpack_from(sign + "IIiqI", body, start)
        item = sign + (_SHORT_EVENT if kind == EVENT and event_bytes == 16 else _ITEMS[kind])
        data = body[start + 24 : start + size]
        assert len(data) == count * struct.calcsize(item), "size and count disagree"
        components.append(WireComponent(kind, number, timestamp_us, list(struct.iter_unpack(item, data))))
        start += size
    assert start == len(body), "bytes after the last component"
    return components
