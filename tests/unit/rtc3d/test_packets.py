import tracemalloc

import pytest

from gateway.errors import PacketError
from gateway.rtc3d.packets import (
    DEFAULT_MAX_C3D_BYTES,
    DEFAULT_MAX_PACKET_BYTES,
    FilePiece,
    Packet,
    PacketReader,
    PacketType,
    decode_text,
    encode_packet,
)
from tests.vectors import PACKETS, PacketVector

LIMIT = 100
C3D_LIMIT = 200

each_packet = pytest.mark.parametrize("vector", PACKETS, ids=[vector.name for vector in PACKETS])


def header(size: int, packet_type: int) -> bytes:
    return size.to_bytes(4, "big") + packet_type.to_bytes(4, "big")


def limited_reader() -> PacketReader:
    return PacketReader(max_packet_bytes=LIMIT, max_c3d_bytes=C3D_LIMIT)


def error_of(reader: PacketReader) -> PacketError:
    assert reader.error is not None
    return reader.error


def test_types_are_numbered_as_in_the_specification() -> None:
    assert [(kind.value, kind.name) for kind in PacketType] == [
        (0, "ERROR"),
        (1, "COMMAND"),
        (2, "XML"),
        (3, "DATA"),
        (4, "NO_DATA"),
        (5, "C3D"),
    ]


@each_packet
def test_each_packet_is_encoded_as_documented(vector: PacketVector) -> None:
    assert encode_packet(vector.type, vector.body) == vector.packet


@each_packet
def test_each_packet_is_read_as_documented(vector: PacketVector) -> None:
    reader = PacketReader()
    assert reader.feed(vector.packet) == [Packet(vector.type, vector.body)]
    assert reader.buffered_bytes == 0
    assert reader.error is None


@pytest.mark.parametrize(
    "vector", [each for each in PACKETS if each.type != 5], ids=lambda vector: vector.name
)
def test_each_packet_is_read_byte_by_byte(vector: PacketVector) -> None:
    reader = PacketReader()
    for count, byte in enumerate(vector.packet[:-1], start=1):
        assert reader.feed(bytes([byte])) == []
        assert reader.buffered_bytes == count
    assert reader.feed(vector.packet[-1:]) == [Packet(vector.type, vector.body)]
    assert reader.buffered_bytes == 0


def test_many_packets_are_read_from_one_piece_and_the_rest_is_kept() -> None:
    reader = PacketReader()
    stream = b"".join(vector.packet for vector in PACKETS)
    assert reader.feed(stream + header(20, 1) + b"Vers") == [
        Packet(vector.type, vector.body) for vector in PACKETS
    ]
    assert reader.buffered_bytes == 12
    assert reader.feed(b"ion 1.0\0" + PACKETS[0].packet) == [
        Packet(1, b"Version 1.0\0"),
        Packet(PACKETS[0].type, PACKETS[0].body),
    ]
    assert reader.buffered_bytes == 0


def test_an_empty_piece_changes_nothing() -> None:
    reader = PacketReader()
    assert reader.feed(b"") == []
    reader.feed(header(12, 3) + b"\0")
    assert reader.feed(b"") == []
    assert reader.buffered_bytes == 9
    assert reader.feed(b"\0\0\0") == [Packet(3, b"\0\0\0\0")]


@pytest.mark.parametrize("packet_type", [6, 0x01000000, 0xFFFFFFFF])
def test_a_packet_of_an_unknown_type_is_read_and_encoded(packet_type: int) -> None:
    packet = header(11, packet_type) + b"new"
    assert limited_reader().feed(packet) == [Packet(packet_type, b"new")]
    assert encode_packet(packet_type, b"new") == packet


def test_a_body_does_not_change_when_more_is_fed() -> None:
    reader = PacketReader()
    reader.feed(header(12, 3))
    (packet,) = reader.feed(b"abcd" + header(12, 3))
    reader.feed(b"efgh" * 100)
    assert packet.body == b"abcd"


# Bounds of the size field ---------------------------------------------------------------------


@pytest.mark.parametrize("packet_type", [0, 1, 2, 3, 4, 6, 0xFFFFFFFF])
@pytest.mark.parametrize("size", [8, 9, LIMIT])
def test_sizes_from_8_to_the_limit_are_accepted(size: int, packet_type: int) -> None:
    reader = limited_reader()
    assert reader.feed(header(size, packet_type) + bytes(size - 8)) == [Packet(packet_type, bytes(size - 8))]
    assert reader.error is None


@pytest.mark.parametrize("packet_type", [0, 1, 2, 3, 4, 6, 0xFFFFFFFF])
@pytest.mark.parametrize("size", [0, 7, LIMIT + 1, 0xFFFFFFFF])
def test_other_sizes_are_an_error_as_soon_as_the_header_is_complete(size: int, packet_type: int) -> None:
    reader = limited_reader()
    assert reader.feed(header(size, packet_type)) == []
    error = error_of(reader)
    assert (error.size, error.packet_type, error.offset) == (size, packet_type, 0)


@pytest.mark.parametrize("size", [8, LIMIT + 1, C3D_LIMIT])
def test_a_c3d_file_has_its_own_limit(size: int) -> None:
    reader = limited_reader()
    assert reader.feed(header(size, 5) + bytes(size - 8)) == [Packet(5, bytes(size - 8))]
    assert reader.error is None


def test_a_c3d_file_is_not_collected() -> None:
    reader, wire = limited_reader(), header(108, 5) + bytes(range(100)) + header(8, 4)
    pieces = []
    for start in range(0, len(wire), 30):
        pieces += reader.feed(wire[start : start + 30])
        assert reader.buffered_bytes <= 8
    *pieces, after = pieces
    assert after == Packet(4, b"")
    assert all(isinstance(piece, FilePiece) for piece in pieces)
    found = [(piece.offset, len(piece.body)) for piece in pieces if isinstance(piece, FilePiece)]
    assert found == [(0, 22), (22, 30), (52, 30), (82, 18)]
    assert b"".join(piece.body for piece in pieces) == bytes(range(100))


def test_an_empty_c3d_file_is_one_empty_piece() -> None:
    [piece, after] = limited_reader().feed(header(8, 5) + header(8, 4))
    assert isinstance(piece, FilePiece)
    assert (piece.body, piece.is_first, piece.is_last) == (b"", True, True)
    assert after == Packet(4, b"")


def test_a_whole_read_of_a_file_is_not_copied() -> None:
    reader, read = PacketReader(), bytes(1000)
    reader.feed(header(10_008, 5))
    [piece] = reader.feed(read)
    assert piece.body is read


def test_the_offset_of_an_error_behind_a_file_counts_its_pieces() -> None:
    reader = limited_reader()
    for data in (header(28, 5) + bytes(5), bytes(15), header(7, 3)):
        reader.feed(data)
    assert error_of(reader).offset == 28


@pytest.mark.parametrize("size", [7, C3D_LIMIT + 1])
def test_a_c3d_file_beyond_its_limit_is_an_error(size: int) -> None:
    reader = limited_reader()
    assert reader.feed(header(size, 5)) == []
    assert (error_of(reader).size, error_of(reader).packet_type) == (size, 5)


def test_the_c3d_limit_may_be_below_the_packet_limit() -> None:
    reader = PacketReader(max_packet_bytes=200, max_c3d_bytes=100)
    reader.feed(header(101, 5))
    assert error_of(reader).size == 101


def test_the_default_limits_are_16_mib_and_256_mib() -> None:
    assert DEFAULT_MAX_PACKET_BYTES == 16 * 1024 * 1024
    assert DEFAULT_MAX_C3D_BYTES == 256 * 1024 * 1024
    for packet_type, limit in [(3, DEFAULT_MAX_PACKET_BYTES), (5, DEFAULT_MAX_C3D_BYTES)]:
        within, beyond = PacketReader(), PacketReader()
        within.feed(header(limit, packet_type))
        beyond.feed(header(limit + 1, packet_type))
        assert within.error is None
        assert error_of(beyond).size == limit + 1


def test_the_error_of_a_small_size_has_size_bound_type_and_offset() -> None:
    reader = limited_reader()
    reader.feed(PACKETS[1].packet + header(7, 3))
    text = str(error_of(reader))
    assert "size 7" in text
    assert "less than the header's 8" in text
    assert "type 3" in text
    assert "byte 20" in text


@pytest.mark.parametrize(("packet_type", "limit"), [(2, LIMIT), (5, C3D_LIMIT)])
def test_the_error_of_a_large_size_has_size_limit_type_and_offset(packet_type: int, limit: int) -> None:
    reader = limited_reader()
    # "SSH-" as the size: another protocol's greeting, read as a header.
    reader.feed(header(0x5353482D, packet_type))
    text = str(error_of(reader))
    assert f"size {0x5353482D}" in text
    assert f"limit {limit}" in text
    assert f"type {packet_type}" in text
    assert "byte 0 " in text
    assert "check host and port" in text


@pytest.mark.parametrize("piece", [8, 100])
def test_the_error_has_the_first_60_bytes(piece: int) -> None:
    reader = limited_reader()
    greeting = b"SSH-2.0-" + bytes(range(92))
    reader.feed(PACKETS[1].packet + greeting[:piece])
    assert error_of(reader).first_bytes == greeting[: min(piece, 60)]


# Of 20, 8 and 15 bytes: the next packet starts at byte 43 of the stream.
EARLIER = (PACKETS[1], PACKETS[4], PACKETS[5])
EARLIER_STREAM = b"".join(vector.packet for vector in EARLIER)
EARLIER_PACKETS = [Packet(vector.type, vector.body) for vector in EARLIER]


def test_packets_before_the_error_are_returned_and_counted_in_its_offset() -> None:
    reader = limited_reader()
    assert reader.feed(EARLIER_STREAM + header(0, 1) + b"rest") == EARLIER_PACKETS
    assert error_of(reader).offset == 43


@pytest.mark.parametrize("piece", [1, 3, 8, 19, 21])
def test_the_offset_does_not_depend_on_how_the_stream_is_split(piece: int) -> None:
    reader = limited_reader()
    stream = EARLIER_STREAM + header(LIMIT + 1, 1)
    packets = []
    for start in range(0, len(stream), piece):
        packets += reader.feed(stream[start : start + piece])
    assert packets == EARLIER_PACKETS
    assert error_of(reader).offset == 43


def test_an_invalid_size_is_no_error_before_its_header_is_complete() -> None:
    reader = limited_reader()
    reader.feed(header(7, 1)[:7])
    assert reader.error is None
    reader.feed(header(7, 1)[7:])
    assert error_of(reader).size == 7


@pytest.mark.parametrize("first", [b"", b"\0\0"], ids=["at once", "after a part of the header"])
def test_after_the_error_nothing_is_returned_or_kept(first: bytes) -> None:
    reader = limited_reader()
    reader.feed(first)
    reader.feed(header(7, 1)[len(first) :] + PACKETS[1].packet)
    error = error_of(reader)
    assert reader.buffered_bytes == 0
    assert reader.feed(PACKETS[1].packet) == []
    assert reader.buffered_bytes == 0
    assert reader.error is error


def test_a_packet_of_4_gib_cannot_be_encoded() -> None:
    body = bytes(0xFFFFFFFF - 7)  # zeros that are never touched take no memory
    with pytest.raises(PacketError, match="4294967296") as caught:
        encode_packet(2, body)
    assert (caught.value.size, caught.value.packet_type) == (4294967296, 2)


@pytest.mark.interpreted
def test_the_largest_packet_can_be_encoded() -> None:
    class Body(bytes):  # reports a length that a test should not allocate
        def __new__(cls, length: int) -> "Body":
            body = super().__new__(cls)
            body.length = length
            return body

        length: int

        def __len__(self) -> int:
            return self.length

    assert encode_packet(2, Body(0xFFFFFFFF - 8)) == b"\xff\xff\xff\xff\0\0\0\x02"
    with pytest.raises(PacketError, match="4294967296"):
        encode_packet(2, Body(0xFFFFFFFF - 7))


# Memory ---------------------------------------------------------------------------------------


def test_a_header_that_claims_16_mib_uses_only_the_memory_of_what_arrived() -> None:
    reader = PacketReader()
    tracemalloc.start()
    try:
        reader.feed(header(16 * 1024 * 1024, 3) + bytes(1000))
        reader.feed(bytes(1000))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert reader.buffered_bytes == 2008
    assert peak < 100_000


def test_the_memory_of_a_large_packet_is_freed() -> None:
    reader = PacketReader()
    large = header(1_000_000, 3) + bytes(999_992)
    tracemalloc.start()
    try:
        for start in range(0, len(large), 100_000):
            reader.feed(large[start : start + 100_000])
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert reader.buffered_bytes == 0
    assert held < 100_000


def test_a_long_read_after_an_incomplete_packet_is_not_copied_as_a_whole() -> None:
    packet = encode_packet(PacketType.DATA, bytes(1992))
    reader = PacketReader()
    reader.feed(packet[:1000])
    rest = packet[1000:] + packet * 500 + packet[:10]
    tracemalloc.start()
    try:
        packets = reader.feed(rest)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (len(packets), reader.buffered_bytes) == (501, 10)
    assert peak - held < len(rest) / 10


# Text of bodies -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (b"", ""),
        (b"OK-Version 1.0", "OK-Version 1.0"),
        (b"Version 1.0\0", "Version 1.0"),
        (b"StreamFrames\n", "StreamFrames"),
        (b"StreamFrames 3D \r\n\0\0", "StreamFrames 3D"),
        (b"\0\0\0", ""),
        (b"Version 1.0 \0what the buffer held before", "Version 1.0"),
        (b"d\xe9j\xe0 vu\xff\0", "d\xe9j\xe0 vu\xff"),
    ],
)
def test_nuls_and_white_space_at_the_end_are_not_part_of_a_text(body: bytes, text: str) -> None:
    assert decode_text(body) == text
