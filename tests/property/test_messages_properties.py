"""Messages and their keys: both byte orders give the same bytes, and no input crashes or collides."""

import contextlib
import json
import re
import struct
from urllib.parse import unquote

import zenoh
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ProtocolError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.decode import decode, to_json
from gateway.messages.encode import Stamp, encode_message, tool_poses
from gateway.messages.summary import summarise
from gateway.messages.topics import escape_key_chunk, lcm_channel, unique_name, zenoh_key
from gateway.outputs.contract import OutputHealth, OutputStatus
from gateway.publish.status_messages import clock_message, status_message
from gateway.rtc3d.components import Component, ComponentType
from gateway.rtc3d.frames import split_frame
from gateway.session.status import StreamStatus
from tests.support.strategies import damaged
from tests.support.vectors import FULL_FRAME, ByteOrder

ORDERS: tuple[ByteOrder, ...] = ("big", "little")
# Words of 4 bytes per item, by §7.3 to §7.7.
WORDS = {
    ComponentType.MARKERS: 4,
    ComponentType.ANALOG: 1,
    ComponentType.FORCE: 6,
    ComponentType.TOOLS: 8,
    ComponentType.EVENT: 4,
}
# Missing, a quiet and a signalling NaN, one with a payload, infinity, -0.0, the smallest denormal.
ODD_FLOATS = [
    0xFFFFFFFF, 0x7FC00000, 0x7F800001, 0xFFA5A5A5, 0x7F800000, 0x80000000, 0x00000001,
]  # fmt: skip

int32s = st.integers(-(2**31), 2**31 - 1)
int64s = st.integers(-(2**63), 2**63 - 1)
stamps = st.builds(Stamp, int64s, int64s, int32s, int32s)
words = st.integers(0, 2**32 - 1) | st.sampled_from(ODD_FLOATS)
kinds = st.sampled_from(ComponentType)


@st.composite
def word_lists(draw: st.DrawFn, kind: ComponentType) -> list[int]:
    size = WORDS[kind] * draw(st.integers(0, 5))
    return draw(st.lists(words, min_size=size, max_size=size))


def component(
    kind: ComponentType, frame_number: int, timestamp_us: int, values: list[int], order: ByteOrder
) -> Component:
    mark = ">" if order == "big" else "<"
    count = len(values) // WORDS[kind]
    size = 24 + 4 * len(values)
    header = struct.pack(f"{mark}IIIiqI", 1, size, kind, frame_number, timestamp_us, count)
    (built,) = split_frame(header + struct.pack(f"{mark}{len(values)}I", *values), order).components
    return built


@given(st.data(), kinds, int32s, int64s, stamps, int64s)
def test_both_byte_orders_give_the_same_message_bit_for_bit(
    data: st.DataObject,
    kind: ComponentType,
    frame_number: int,
    timestamp_us: int,
    stamp: Stamp,
    sequence: int,
) -> None:
    values = data.draw(word_lists(kind))
    big, little = (
        encode_message(component(kind, frame_number, timestamp_us, values, order), stamp, sequence)
        for order in ORDERS
    )
    assert big == little
    count = len(values) // WORDS[kind]
    items = struct.pack(f">{len(values)}I", *values)
    if kind is ComponentType.EVENT:
        time = struct.pack(">q", timestamp_us)
        events = [items[at : at + 16] for at in range(0, len(items), 16)]
        items = b"".join(event[:4] + time + event[4:] for event in events)
    ours = struct.pack(
        ">qqqii", stamp.utime, stamp.capture_utime, sequence, stamp.session, stamp.parameters_version
    )
    assert big[8:] == ours + struct.pack(">iqi", frame_number, timestamp_us, count) + items


@given(int64s, int64s, int32s, int32s, st.lists(st.integers(-2, 2) | int64s, min_size=1))
def test_a_prefix_has_the_requested_sequence_number(
    utime: int, capture_utime: int, session: int, version: int, sequences: list[int]
) -> None:
    stamp = Stamp(utime, capture_utime, session, version)
    for sequence in sequences:
        expected = struct.pack(">qqqii", utime, capture_utime, sequence, session, version)
        assert stamp.prefix(sequence) == expected


STAMP = Stamp(1, 2, 3, 4)
COMPONENTS = split_frame(FULL_FRAME["big"], "big").components
TOOLS = next(component for component in COMPONENTS if component.type is ComponentType.TOOLS)
STATUS = status_message(
    source="lab",
    server="192.0.2.20:3020",
    sequence=1,
    streams=[(StreamStatus("3d", limitations=["no parameters"]), 60.0)],
    outputs=[(OutputStatus("zenoh"), OutputHealth(True), {"ok": 1})],
    stall_timeout_s=2.0,
    frame=CoordinateFrame("lab"),
)
CLOCK = clock_message(1, 2, StreamStatus("3d"))
valid = st.sampled_from(
    [
        *(encode_message(each, STAMP, 1) for each in COMPONENTS),
        *tool_poses(TOOLS, STAMP, [1, 2], CoordinateFrame("lab")),
        STATUS.encode(),
        CLOCK.encode(),
    ]
)


@given(damaged(valid) | st.binary(max_size=100))
def test_damaged_messages_raise_only_protocol_errors_and_decoded_ones_can_be_shown(message: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        decoded = decode(message)
        assert summarise(decoded)
        assert json.dumps(to_json(decoded), allow_nan=False)


# --- keys and channels


labels = st.text(max_size=80)


@given(labels)
def test_any_label_becomes_one_chunk_of_a_valid_zenoh_key(label: str) -> None:
    key = zenoh.KeyExpr(zenoh_key("mocap", "lab", "6d", label))
    assert len(str(key).split("/")) == 4
    assert not key.includes("mocap/lab/6d/another")


@given(labels)
def test_a_label_can_be_read_back_from_its_key(label: str) -> None:
    chunk = escape_key_chunk(label)
    assert unquote(chunk) == label or (label, chunk) == ("", "%")


@given(st.from_regex(r"[A-Za-z0-9_]{1,16}", fullmatch=True), labels, labels)
def test_any_label_gives_a_valid_lcm_channel(prefix: str, source: str, label: str) -> None:
    channel = lcm_channel(prefix, source, "6d", label)
    assert re.fullmatch(re.escape(prefix) + "_[A-Z0-9_]+", channel)
    assert len(channel) <= 63


@given(st.lists(labels, max_size=30), st.integers(4, 63))
def test_unique_names_differ_and_keep_to_the_length(wanted: list[str], max_length: int) -> None:
    taken: list[str] = []
    for name in wanted:
        taken.append(unique_name(name, taken, max_length))
    assert len(set(taken)) == len(wanted)
    assert all(len(name) <= max_length for name in taken)
