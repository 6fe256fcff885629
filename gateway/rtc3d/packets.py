"""General-purpose packets (§4.1): an 8-byte header, size and type, always big-endian, then the body."""

import struct
from enum import IntEnum
from typing import NamedTuple

from gateway.errors import PacketError

HEADER = struct.Struct(">II")
DEFAULT_MAX_PACKET_BYTES = 16 * 1024 * 1024
DEFAULT_MAX_C3D_BYTES = 256 * 1024 * 1024
_MAX_SIZE = 0xFFFFFFFF
_SHOWN_BYTES = 60  # of what is no packet


class PacketType(IntEnum):
    """The data types of §4.2."""

    ERROR = 0
    COMMAND = 1
    XML = 2
    DATA = 3
    NO_DATA = 4
    C3D = 5


class Packet(NamedTuple):
    """One packet as it came: ``type`` may be a number that §4.2 does not know."""

    type: int
    body: bytes


def encode_packet(packet_type: int, body: bytes = b"") -> bytes:
    """Return the packet's bytes: big-endian size (body + 8) and type, then ``body`` (§4.1).

    Raises PacketError if the body does not fit the 32-bit size field.
    """
    size = HEADER.size + len(body)
    if size > _MAX_SIZE:
        raise PacketError(
            f"a packet of {size} bytes does not fit its 32-bit size field",
            size=size,
            packet_type=packet_type,
            offset=0,
        )
    return HEADER.pack(size, packet_type) + body


def text_of(body: bytes) -> str:
    """Return a type 0 or 1 body as text: NULs and white space around it are dropped (field notes 8, 13).

    Bytes that are not ASCII are kept as Latin-1, so that any body can be shown.
    """
    return body.decode("latin-1").strip("\0 \t\r\n")


class PacketReader:
    """Cuts a byte stream into packets, whatever the splits it arrives in.

    ``max_packet_bytes`` bounds every packet's size field, ``max_c3d_bytes`` that of a complete C3D
    file (type 5). The memory held is what has arrived of the packet in progress, never what its
    size field claims.
    """

    def __init__(
        self,
        max_packet_bytes: int = DEFAULT_MAX_PACKET_BYTES,
        max_c3d_bytes: int = DEFAULT_MAX_C3D_BYTES,
    ) -> None:
        self._max_packet_bytes = max_packet_bytes
        self._max_c3d_bytes = max_c3d_bytes
        self._partial = bytearray()
        self.is_between_packets = True
        """Whether the stream can be read on, and the next byte begins a packet."""
        self.offset = 0
        """Where in the stream the next packet begins; whoever takes packets past the reader counts them."""
        self.error: PacketError | None = None
        """Set once a size field was below 8 or above its limit: the stream has no further packets."""

    @property
    def buffered_bytes(self) -> int:
        """How many bytes of an unfinished packet are held."""
        return len(self._partial)

    @property
    def unfinished(self) -> bytes:
        """What has come of an unfinished packet."""
        return bytes(self._partial)

    @property
    def missing_bytes(self) -> int:
        """How many bytes complete the unfinished packet, or its header; 0 between two packets."""
        if not self._partial:
            return 0
        if len(self._partial) < HEADER.size:
            return HEADER.size - len(self._partial)
        size, _ = HEADER.unpack_from(self._partial)
        return int(size) - len(self._partial)

    def feed(self, data: bytes) -> list[Packet]:
        """Take the next bytes of the stream and return the packets that they complete, in order.

        Never raises: look at ``error`` after handling what was returned. Once it is set, further
        bytes are thrown away.
        """
        error = self.error  # of before; what follows may set it
        if error is not None:
            return []
        if not self._partial:
            packets, used = self._cut(data)
            self._partial += data[used:]
        else:
            self._partial += data
            with memoryview(self._partial) as view:
                packets, used = self._cut(view)
            del self._partial[:used]
        self.is_between_packets = not self._partial and self.error is None
        return packets

    def skip_unfinished(self, num_bytes: int) -> None:
        """Drop the unfinished packet: the caller has taken it, with the ``num_bytes`` that completed it."""
        self.offset += len(self._partial) + num_bytes
        self._partial.clear()
        self.is_between_packets = True

    def _cut(self, source: bytes | memoryview) -> tuple[list[Packet], int]:
        """Return the complete packets at the start of ``source`` and how many bytes they take."""
        packets: list[Packet] = []
        available = len(source)
        start = 0
        while available - start >= HEADER.size:
            size, packet_type = HEADER.unpack_from(source, start)
            limit = self._max_c3d_bytes if packet_type == PacketType.C3D else self._max_packet_bytes
            if not HEADER.size <= size <= limit:
                begin = bytes(source[start : start + _SHOWN_BYTES])
                self.error = _size_error(size, packet_type, self.offset + start, limit, begin)
                start = available
                break
            end = start + size
            if end > available:
                break
            packets.append(Packet(packet_type, bytes(source[start + HEADER.size : end])))
            start = end
        self.offset += start
        return packets, start


def _size_error(size: int, packet_type: int, offset: int, limit: int, begin: bytes) -> PacketError:
    bound = f"less than the header's {HEADER.size}" if size < HEADER.size else f"limit {limit}"
    return PacketError(
        f"packet size {size} ({bound}), type {packet_type}, at byte {offset} of the stream: "
        "this is no RTC3D server, or the connection is corrupt; check host and port",
        size=size,
        packet_type=packet_type,
        offset=offset,
        begin=begin,
    )
