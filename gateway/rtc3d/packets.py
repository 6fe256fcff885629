"""General-purpose packets (§4.1): a size and a type, 4 bytes each and always big-endian, then the body."""

import struct
from enum import IntEnum
from typing import Final

from gateway.errors import PacketError

FIRST_PRINCIPLES_PORT: Final = 3020
WAVEFRONT_PORT: Final = 3030
"""The TCP ports on which RT servers listen by default (§2, field note 12)."""

PACKET_HEADER: Final = struct.Struct(">II")
PACKET_HEADER_BYTES: Final = 8
DEFAULT_MAX_PACKET_BYTES: Final = 16 * 1024 * 1024
DEFAULT_MAX_C3D_BYTES: Final = 256 * 1024 * 1024
_MAX_SIZE: Final = 0xFFFFFFFF
_MAX_BEGIN_BYTES: Final = 60  # of PacketError.begin
ALL_PACKETS: Final = 0x7FFFFFFF
"""More packets than fit into memory."""


class PacketType(IntEnum):
    """The data types of §4.2."""

    ERROR = 0
    COMMAND = 1
    XML = 2
    DATA = 3
    NO_DATA = 4
    C3D = 5


# These save time for every packet: an attribute look-up or a comparison with an IntEnum takes 0.1 µs.
_unpack_header: Final = PACKET_HEADER.unpack_from
DATA: Final = int(PacketType.DATA)
_C3D: Final = int(PacketType.C3D)


class Packet:
    """One packet; ``type`` may be a number that §4.2 does not define."""

    __slots__ = ("body", "type")

    def __init__(self, packet_type: int, body: bytes) -> None:
        self.type = packet_type
        self.body = body

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Packet) and (self.type, self.body) == (other.type, other.body)

    def __hash__(self) -> int:
        return hash((self.type, self.body))

    def __repr__(self) -> str:
        return f"Packet({self.type}, {self.body!r})"


class FilePiece(Packet):
    """A piece of a complete C3D file (type 5), as it arrives: ``body`` is that from byte ``offset`` on.

    The file has ``file_bytes`` in total. An empty file is one empty piece.
    """

    __slots__ = ("file_bytes", "offset")

    def __init__(self, body: bytes, offset: int, file_bytes: int) -> None:
        super().__init__(_C3D, body)
        self.offset = offset
        self.file_bytes = file_bytes

    @property
    def is_first(self) -> bool:
        """Whether the file begins with this piece."""
        return self.offset == 0

    @property
    def is_last(self) -> bool:
        """Whether the file is complete with this piece."""
        return self.offset + len(self.body) == self.file_bytes

    def __repr__(self) -> str:
        return f"FilePiece({self.body!r}, {self.offset}, {self.file_bytes})"


def encode_packet(packet_type: int, body: bytes = b"") -> bytes:
    """Return the packet's bytes: big-endian size (body + 8) and type, then ``body`` (§4.1).

    Raises PacketError if the body does not fit the 32-bit size field.
    """
    size = PACKET_HEADER_BYTES + len(body)
    if size > _MAX_SIZE:
        raise PacketError(
            f"a packet of {size} bytes does not fit its 32-bit size field",
            size=size,
            packet_type=packet_type,
            offset=0,
        )
    return PACKET_HEADER.pack(size, packet_type) + body


def decode_text(body: bytes) -> str:
    """Return a type 0 or 1 body as text, without NULs and white space around it (field notes 8, 13).

    A NUL ends the text; bytes after it are ignored (field note 17). Bytes that are not ASCII are read as
    Latin-1, so that any body can be shown.
    """
    return body.decode("latin-1").strip("\0 \t\r\n").partition("\0")[0].rstrip()


class PacketReader:
    """Cuts a byte stream into packets, however the stream is split into reads.

    ``max_c3d_bytes`` limits the size field of a complete C3D file (type 5), ``max_packet_bytes`` that of
    every other packet. The reader allocates memory for the bytes that have arrived, never for the size
    that a header claims. It does not collect C3D files, but returns a FilePiece for each piece that arrives.
    """

    def __init__(
        self,
        max_packet_bytes: int = DEFAULT_MAX_PACKET_BYTES,
        max_c3d_bytes: int = DEFAULT_MAX_C3D_BYTES,
    ) -> None:
        self._max_packet_bytes = max_packet_bytes
        self._max_c3d_bytes = max_c3d_bytes
        self._offset = 0  # of the next packet in the stream
        self._partial = bytearray()
        self._partial_goal = 0  # the length that _partial needs before a packet, or its header, is complete
        self._file_bytes = 0  # the length of the C3D file that is arriving
        self._missing_file_bytes = 0  # of that file
        self._rest = b""  # the read that ``feed`` did not finish, from _rest_start on
        self._rest_start = 0
        self.has_more = False
        """Whether ``feed`` has not looked at all bytes yet, because it returned as many packets as wanted."""
        self.error: PacketError | None = None
        """Set when a size field is below 8 or above its limit; the stream then has no further packets."""

    @property
    def buffered_bytes(self) -> int:
        """The number of bytes held of an incomplete packet; of a C3D file, those of an incomplete header."""
        return len(self._partial)

    def feed(self, data: bytes, max_packets: int = ALL_PACKETS) -> list[Packet]:
        """Take the next bytes; return the packets that they complete and the pieces of files, in order.

        Returns at most ``max_packets``. While ``has_more``, call it again, with b"" or with the next bytes.
        Never raises: check ``error`` after handling the packets. Once it is set, further bytes are ignored.
        """
        if self.error is not None:
            return []
        packets: list[Packet] = []
        used = 0
        if self.has_more:
            # Compiled code would copy the read to add b"".
            data, used, self._rest = self._rest + data if data else self._rest, self._rest_start, b""
            self.has_more = False
        elif self._missing_file_bytes:
            used = self._take_file_piece(data, 0, packets)
            self._offset += used
        elif self._partial:
            # Copy only what completes the packet; a read can contain a hundred more, which are cut in place.
            # If even the header is incomplete, copy the whole read: an error quotes the bytes after a header.
            missing = self._partial_goal - len(self._partial)
            used = len(data) if self._partial_goal == PACKET_HEADER_BYTES else min(missing, len(data))
            self._partial += data[:used]
            if len(self._partial) < self._partial_goal:
                return []
            completed = bytes(self._partial)
            self._partial.clear()
            self._cut(completed, 0, packets, max_packets)
        if used < len(data):
            self._cut(data, used, packets, max_packets)
        return packets

    def _take_file_piece(self, data: bytes, start: int, packets: list[Packet]) -> int:
        """Append a piece of a C3D file that is in ``data`` from ``start`` on; return where it ends."""
        is_whole_read = start == 0 and len(data) <= self._missing_file_bytes  # which is not copied then
        piece = data if is_whole_read else data[start : start + self._missing_file_bytes]
        # A piece without content says nothing, unless the file is empty.
        if piece or not self._file_bytes:
            packets.append(FilePiece(piece, self._file_bytes - self._missing_file_bytes, self._file_bytes))
        self._missing_file_bytes -= len(piece)
        return start + len(piece)

    def _cut(self, data: bytes, first: int, packets: list[Packet], max_packets: int) -> None:
        """Append the complete packets in ``data`` from offset ``first``; keep the rest in ``_partial``.

        If there are more than ``max_packets``, keep the others in ``_rest``.
        """
        available = len(data)
        start = first
        # Struct's methods return Any. Annotated as int, compiled code compares and slices with C integers.
        size: int
        packet_type: int
        while available - start >= PACKET_HEADER_BYTES:
            if len(packets) >= max_packets:
                self._rest, self._rest_start, self.has_more = data, start, True
                self._offset += start - first
                return
            size, packet_type = _unpack_header(data, start)
            limit = self._max_c3d_bytes if packet_type == _C3D else self._max_packet_bytes
            if not PACKET_HEADER_BYTES <= size <= limit:
                is_small = size < PACKET_HEADER_BYTES
                bound = f"less than the header's {PACKET_HEADER_BYTES}" if is_small else f"limit {limit}"
                offset = self._offset + start - first
                self.error = PacketError(
                    f"packet size {size} ({bound}), type {packet_type}, at byte {offset} of the stream: "
                    "this is not an RTC3D server, or the connection is corrupt; check host and port",
                    size=size,
                    packet_type=packet_type,
                    offset=offset,
                    first_bytes=data[start : start + _MAX_BEGIN_BYTES],
                )
                return
            end = start + size
            if packet_type == _C3D:
                self._file_bytes = self._missing_file_bytes = size - PACKET_HEADER_BYTES
                start = self._take_file_piece(data, start + PACKET_HEADER_BYTES, packets)
                continue
            if end > available:
                self._partial_goal = size
                break
            packets.append(Packet(packet_type, data[start + PACKET_HEADER_BYTES : end]))
            start = end
        else:
            self._partial_goal = PACKET_HEADER_BYTES
        self._offset += start - first
        if start < available:
            self._partial += data[start:]
