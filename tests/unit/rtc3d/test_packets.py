"""General-purpose packets (§4.1): limits, errors, encoding, C3D files and memory.

The properties in test_packets_properties.py prove how any stream is cut into packets.
"""

import tracemalloc

import pytest

from gateway.errors import PacketError
from gateway.rtc3d.packets import (
    DEFAULT_MAX_C3D_BYTES,
    DEFAULT_MAX_PACKET_BYTES,
    Packet,
    PacketReader,
    PacketType,
    decode_text,
    encode_packet,
)
from tests.support.errors import names
from tests.support.vectors import PACKETS


def header(size: int, packet_type: int) -> bytes:
    return size.to_bytes(4, "big") + packet_type.to_bytes(4, "big")


def reader_after(*pieces: bytes) -> PacketReader:
    reader = PacketReader(max_packet_bytes=100, max_c3d_bytes=200)
    for piece in pieces:
        reader.feed(piece)
    return reader


def error_of(reader: PacketReader) -> PacketError:
    assert reader.error is not None
    return reader.error


def test_types_are_numbered_as_in_the_specification() -> None:
    """A wrong number would make every server unusable, and no other test reads the specification."""
    names = ["ERROR", "COMMAND", "XML", "DATA", "NO_DATA", "C3D"]
    assert {kind.value: kind.name for kind in PacketType} == dict(enumerate(names))


def test_each_packet_is_encoded_and_read_as_documented() -> None:
    """The bytes are those of the specification, written by hand, and nothing of them stays in the reader."""
    for vector in PACKETS:
        reader = PacketReader()
        assert encode_packet(vector.type, vector.body) == vector.packet, vector.name
        assert reader.feed(vector.packet) == [Packet(vector.type, vector.body)], vector.name
        assert (reader.buffered_bytes, reader.error) == (0, None), vector.name
    assert encode_packet(4) == header(8, 4)


def test_packets_are_equal_if_type_and_body_are() -> None:
    """Replies are compared with earlier ones, so equality must look at both fields."""
    assert len({Packet(3, b"frame"), Packet(3, b"frame"), Packet(4, b"frame"), Packet(3, b"other")}) == 3
    for other in (Packet(4, b"frame"), Packet(3, b"other"), (3, b"frame"), b"frame", None):
        assert Packet(3, b"frame") != other
    assert repr(Packet(1, b"Bye")) == "Packet(1, b'Bye')"


@pytest.mark.parametrize("most", [1, 2, 3, 4])
def test_no_more_packets_are_returned_than_wanted_and_none_is_lost(most: int) -> None:
    """A burst of frames is processed in parts, so that the event loop stays responsive."""
    reader = reader_after()
    stream = b"".join(encode_packet(3, bytes([number])) for number in range(7))
    batches = []
    for data in (stream[:-4], stream[-4:] + header(7, 1)):
        batches.append(reader.feed(data, most))
        while reader.has_more:
            batches.append(reader.feed(b"", most))
    assert [packet.body[0] for batch in batches for packet in batch] == list(range(7))
    assert [len(batch) for batch in batches[: 6 // most]] == [most] * (6 // most)
    assert error_of(reader).offset == len(stream)
    # Bytes may also arrive while packets wait.
    reader = reader_after()
    assert reader.feed(encode_packet(1, b"a") + encode_packet(1, b"b"), 1) == [Packet(1, b"a")]
    assert reader.feed(encode_packet(1, b"c")) == [Packet(1, b"b"), Packet(1, b"c")]
    assert reader.has_more is False


# Errors ---------------------------------------------------------------------------------------


def test_the_default_limits_are_16_mib_and_256_mib() -> None:
    """The limits protect the memory, and are promised in the documentation."""
    assert (DEFAULT_MAX_PACKET_BYTES, DEFAULT_MAX_C3D_BYTES) == (2**24, 2**28)
    for packet_type, limit in [(3, DEFAULT_MAX_PACKET_BYTES), (5, DEFAULT_MAX_C3D_BYTES)]:
        within, beyond = PacketReader(), PacketReader()
        within.feed(header(limit, packet_type))
        beyond.feed(header(limit + 1, packet_type))
        assert (within.error, error_of(beyond).size) == (None, limit + 1)


@pytest.mark.parametrize(
    ("size", "packet_type", "bound"),
    [
        (7, 1, 8),
        (101, 3, 100),
        (0x5353482D, 5, 200),  # "SSH-", the greeting of another protocol
    ],
)
def test_the_error_says_what_is_wrong_with_the_size_where(size: int, packet_type: int, bound: int) -> None:
    """The user of a wrong port sees which program answers there; nothing more is read."""
    wrong = header(size, packet_type) + bytes(range(92))
    reader = reader_after()
    assert [each.type for each in reader.feed(PACKETS[1].packet + wrong)] == [1]
    error = error_of(reader)
    assert (error.size, error.packet_type, error.offset) == (size, packet_type, 20)
    assert names(str(error), size, bound, packet_type, 20)
    assert error.first_bytes == wrong[:60]
    assert reader.feed(PACKETS[1].packet) == []
    assert (reader.error, reader.buffered_bytes) == (error, 0)


@pytest.mark.interpreted
def test_the_largest_packet_that_can_be_encoded_has_a_size_of_32_bits() -> None:
    """Beyond, the size field would wrap around and corrupt the stream."""

    class Body(bytes):  # reports a length that a test should not allocate
        length = 0xFFFFFFFF - 8

        def __len__(self) -> int:
            return self.length

    body = Body()
    assert encode_packet(2, body) == b"\xff\xff\xff\xff\0\0\0\x02"
    body.length += 1
    with pytest.raises(PacketError) as caught:
        encode_packet(2, body)
    assert (caught.value.size, caught.value.packet_type, caught.value.offset) == (4294967296, 2, 0)


# Memory ---------------------------------------------------------------------------------------


def peak_and_held(reader: PacketReader, *pieces: bytes) -> tuple[int, int]:
    """Return the most memory that feeding ``pieces`` takes, and how much of it stays, in bytes."""
    tracemalloc.start()
    try:
        read = [reader.feed(piece) for piece in pieces]
        del read[:-1]
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return peak, held


def test_a_c3d_file_is_passed_on_in_pieces_and_neither_collected_nor_copied() -> None:
    """A file may have 256 MiB."""
    reader, wire = reader_after(), header(108, 5) + bytes(range(100)) + header(8, 4)
    for start in range(0, len(wire), 30):
        reader.feed(wire[start : start + 30])
        assert reader.buffered_bytes <= 8
    reader, read = PacketReader(), bytes(1000)
    reader.feed(header(10_008, 5))
    assert reader.feed(read)[0].body is read


def test_a_header_that_claims_16_mib_uses_only_the_memory_of_what_arrived() -> None:
    """Anybody who can connect could otherwise fill the memory with a few bytes."""
    reader = PacketReader()
    peak, _ = peak_and_held(reader, header(2**24, 3) + bytes(1000), bytes(1000))
    assert reader.buffered_bytes == 2008
    assert peak < 100_000


def test_the_memory_of_a_large_packet_is_freed() -> None:
    """One large packet must not take memory for as long as the connection lasts."""
    large = header(1_000_000, 3) + bytes(999_992)
    _, held = peak_and_held(
        PacketReader(), *[large[at : at + 100_000] for at in range(0, len(large), 100_000)], b""
    )
    assert held < 100_000


def test_a_long_read_after_an_incomplete_packet_is_not_copied_as_a_whole() -> None:
    """Only what completes the packet is copied, so that a slow link costs no more than a fast one."""
    packet, reader = encode_packet(PacketType.DATA, bytes(1992)), PacketReader()
    reader.feed(packet[:1000])
    rest = packet[1000:] + packet * 500 + packet[:10]
    peak, held = peak_and_held(reader, rest)
    assert reader.buffered_bytes == 10
    assert peak - held < len(rest) / 10


def test_a_text_ends_before_nuls_and_white_space() -> None:
    """Servers and clients end texts in many ways (field notes 8, 13 and 17)."""
    texts = {
        b"OK-Version 1.0": "OK-Version 1.0",
        b"StreamFrames 3D \r\n\0\0": "StreamFrames 3D",
        b"\0\0\0": "",
        b"Version 1.0 \0what the buffer held before": "Version 1.0",
        b"d\xe9j\xe0 vu\xff\0": "d\xe9j\xe0 vu\xff",
    }
    assert {body: decode_text(body) for body in texts} == texts
