from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from gateway.errors import PacketError
from gateway.rtc3d.packets import FilePiece, Packet, PacketReader, decode_text
from tests.support.examples import examples
from tests.support.strategies import damaged, pieces_of

LIMIT = 64
C3D_LIMIT = 96

packet_types = st.sampled_from([0, 1, 2, 3, 4, 5]) | st.integers(0, 0xFFFFFFFF)
packets = st.builds(Packet, packet_types, st.binary(max_size=LIMIT - 8))
packet_lists = st.lists(packets, max_size=8)


def wire(packet: Packet) -> bytes:
    """Return the packet's bytes (§4.1), made without the encoder under test."""
    return (8 + len(packet.body)).to_bytes(4, "big") + packet.type.to_bytes(4, "big") + packet.body


def stream_of(packet_list: list[Packet]) -> bytes:
    return b"".join(wire(packet) for packet in packet_list)


def with_whole_files(read: list[Packet]) -> tuple[list[Packet], bytes]:
    """Return the packets with C3D files in one piece, and the bytes so far of a file that is not complete."""
    packet_list: list[Packet] = []
    content = b""
    for packet in read:
        if not isinstance(packet, FilePiece):
            assert not content
            packet_list.append(packet)
            continue
        assert packet.offset == len(content)
        assert packet.is_first is (not content)
        content += packet.body
        if packet.is_last:
            assert len(content) == packet.file_bytes
            packet_list.append(Packet(5, content))
            content = b""
    unfinished = read[-1] if content else None
    assert unfinished is None or isinstance(unfinished, FilePiece)
    header = b"" if unfinished is None else (8 + unfinished.file_bytes).to_bytes(4, "big") + b"\0\0\0\5"
    return packet_list, header + content


def limit_of(packet_type: int) -> int:
    return C3D_LIMIT if packet_type == 5 else LIMIT


def new_reader() -> PacketReader:
    return PacketReader(max_packet_bytes=LIMIT, max_c3d_bytes=C3D_LIMIT)


def attributes_of(error: PacketError | None) -> tuple[str, int, int, int] | None:
    if error is None:
        return None
    return str(error), error.size, error.packet_type, error.offset


def pieces(streams: SearchStrategy[bytes]) -> SearchStrategy[list[bytes]]:
    return streams.flatmap(pieces_of)


valid_streams = packet_lists.map(stream_of)
# Random bytes seldom have a size near the limits; these headers often do.
headers = st.builds(
    lambda size, packet_type: size.to_bytes(4, "big") + packet_type.to_bytes(4, "big"),
    st.sampled_from([7, 8, LIMIT, LIMIT + 1, C3D_LIMIT, C3D_LIMIT + 1]) | st.integers(0, 0xFFFFFFFF),
    packet_types,
)
any_streams = (
    st.binary(max_size=300)
    | st.builds(lambda *parts: b"".join(parts), valid_streams, headers, st.binary(max_size=C3D_LIMIT))
    | damaged(valid_streams)
    | valid_streams
)


@settings(max_examples=examples(300))
@given(pieces(any_streams))
def test_the_packets_read_from_any_bytes_are_those_in_the_bytes(stream: list[bytes]) -> None:
    reader = new_reader()
    read = []
    for piece in stream:
        read += reader.feed(piece)
    whole = b"".join(stream)
    complete, unfinished = with_whole_files(read)
    assert whole.startswith(stream_of(complete) + unfinished)
    assert all(8 + len(packet.body) <= limit_of(packet.type) for packet in complete)
    rest = whole[len(stream_of(complete)) :]
    size, packet_type = int.from_bytes(rest[:4], "big"), int.from_bytes(rest[4:8], "big")
    if reader.error is None:
        assert len(rest) < 8 or 8 <= size <= limit_of(packet_type)
        assert len(rest) < 8 or len(rest) < size
    else:
        assert not 8 <= size <= limit_of(packet_type)
        assert (reader.error.size, reader.error.packet_type) == (size, packet_type)
        assert reader.error.offset == len(stream_of(complete))


@settings(max_examples=examples(300))
@given(pieces(any_streams))
def test_a_split_of_the_stream_changes_neither_packets_nor_error(stream: list[bytes]) -> None:
    whole, split = new_reader(), new_reader()
    read = []
    for piece in stream:
        read += split.feed(piece)
    assert with_whole_files(read) == with_whole_files(whole.feed(b"".join(stream)))
    assert attributes_of(split.error) == attributes_of(whole.error)
    assert split.buffered_bytes == whole.buffered_bytes


@given(st.binary())
def test_any_body_has_a_text(body: bytes) -> None:
    text = decode_text(body)
    assert text.encode("latin-1") in body
    assert not text.endswith(("\0", " ", "\t", "\r", "\n"))
