from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from gateway.errors import FrameError
from gateway.rtc3d.components import (
    ITEM_DTYPES,
    LONG_EVENT,
    SHORT_EVENT,
    Component,
    ComponentType,
    big_endian_content,
    encode_component,
)
from gateway.rtc3d.frames import FrameReader, RawFrame, detect_byte_order, encode_frame, split_frame
from tests.support.examples import examples
from tests.support.strategies import damaged
from tests.support.vectors import FRAME_WITH_UNKNOWN, FULL_FRAME, ByteOrder

# The bytes of each field of one item (§7.3 to §7.7, field note 6).
FIELD_BYTES = {
    "3d": (4, 4, 4, 4),
    "analog": (4,),
    "force": (4, 4, 4, 4, 4, 4),
    "6d": (4, 4, 4, 4, 4, 4, 4, 4),
    "short event": (4, 4, 4, 4),
    "long event": (4, 8, 4, 4, 4),
}
KINDS = {
    "3d": (1, ITEM_DTYPES[ComponentType.MARKERS]),
    "analog": (2, ITEM_DTYPES[ComponentType.ANALOG]),
    "force": (3, ITEM_DTYPES[ComponentType.FORCE]),
    "6d": (4, ITEM_DTYPES[ComponentType.TOOLS]),
    "short event": (5, SHORT_EVENT),
    "long event": (5, LONG_EVENT),
}


class RawComponent(NamedTuple):
    """The values of one component; ``data`` is its items in big-endian form, with any bits."""

    kind: str
    frame_number: int
    timestamp_us: int
    data: bytes

    def items(self) -> npt.NDArray[Any]:
        return np.frombuffer(self.data, KINDS[self.kind][1])

    def encode(self, order: ByteOrder) -> bytes:
        kind = ComponentType(KINDS[self.kind][0])
        return encode_component(kind, self.frame_number, self.timestamp_us, self.items(), order)

    def content(self, order: ByteOrder) -> bytes:
        """Return the component's bytes after size and type, made without the encoder under test."""
        fields = FIELD_BYTES[self.kind]
        count = len(self.data) // sum(fields)
        parts = [
            self.frame_number.to_bytes(4, order, signed=True),
            self.timestamp_us.to_bytes(8, order, signed=True),
            count.to_bytes(4, order),
        ]
        start = 0
        for width in fields * count:
            part = self.data[start : start + width]
            parts.append(part if order == "big" else part[::-1])
            start += width
        return b"".join(parts)

    def wire(self, order: ByteOrder) -> bytes:
        content = self.content(order)
        header = (8 + len(content)).to_bytes(4, order) + KINDS[self.kind][0].to_bytes(4, order)
        return header + content


ODD_FLOATS = [
    bytes.fromhex(bits)
    for bits in (
        "FFFFFFFF",  # missing
        "7FC00000",  # quiet NaN
        "7F800001",  # signalling NaN
        "FFA5A5A5",  # signalling NaN with a payload
        "7F800000",  # infinity
        "80000000",  # -0.0
        "00000001",  # the smallest denormal
    )
]


@st.composite
def raw_components(draw: st.DrawFn) -> RawComponent:
    kind = draw(st.sampled_from(sorted(KINDS)))
    words = sum(FIELD_BYTES[kind]) // 4 * draw(st.integers(0, 4))
    word = st.binary(min_size=4, max_size=4) | st.sampled_from(ODD_FLOATS)
    return RawComponent(
        kind,
        draw(st.integers(-(2**31), 2**31 - 1)),
        draw(st.integers(-(2**63), 2**63 - 1)),
        b"".join(draw(st.lists(word, min_size=words, max_size=words))),
    )


orders: SearchStrategy[ByteOrder] = st.sampled_from(["big", "little"])
raw_component_lists = st.lists(raw_components(), max_size=5)


def frame(components: list[bytes], order: ByteOrder) -> bytes:
    return len(components).to_bytes(4, order) + b"".join(components)


valid_bodies = (st.sampled_from([*FULL_FRAME.values(), *FRAME_WITH_UNKNOWN.values()])) | st.builds(
    lambda components, order: frame([raw.wire(order) for raw in components], order),
    raw_component_lists,
    orders,
)
any_bodies = damaged(valid_bodies) | valid_bodies | st.binary(max_size=300)


@given(raw_component_lists, orders)
def test_splitting_an_encoded_frame_returns_its_components(
    components: list[RawComponent], order: ByteOrder
) -> None:
    split = split_frame(encode_frame([raw.encode(order) for raw in components], order), order)
    assert split.layout.unknown_types == ()
    for raw, component in zip(components, split.components, strict=True):
        item_bytes = sum(FIELD_BYTES[raw.kind])
        assert component.type == KINDS[raw.kind][0]
        assert component.frame_number == raw.frame_number
        assert component.timestamp_us == raw.timestamp_us
        assert component.num_items == len(raw.data) // item_bytes
        assert component.byte_order == order
        assert bytes(component.content) == raw.content(order)
        assert component.items().tobytes() == raw.content(order)[16:]
        if component.num_items:
            assert component.item_bytes == item_bytes
            assert component.items().dtype.names == KINDS[raw.kind][1].names


unknown_types = st.integers(0, 0xFFFFFFFF).filter(lambda kind: not 1 <= kind <= 5)
unknown_components = st.tuples(unknown_types, st.binary(max_size=40))


@given(st.lists(raw_components() | unknown_components, max_size=6), orders)
def test_unknown_components_are_skipped_at_any_position(
    components: list[RawComponent | tuple[int, bytes]], order: ByteOrder
) -> None:
    wires, known, unknown = [], [], []
    for raw in components:
        if isinstance(raw, RawComponent):
            known.append(raw.content(order))
            wires.append(raw.wire(order))
        else:
            kind, data = raw
            unknown.append(kind)
            wires.append((8 + len(data)).to_bytes(4, order) + kind.to_bytes(4, order) + data)
    split = split_frame(frame(wires, order), order)
    assert [bytes(component.content) for component in split.components] == known
    assert list(split.layout.unknown_types) == unknown


# Arbitrary bytes ------------------------------------------------------------------------------


def split_or_none(body: bytes, order: ByteOrder) -> RawFrame | None:
    try:
        return split_frame(body, order)
    except FrameError:
        return None


def assert_consistent(component: Component, order: ByteOrder) -> None:
    """Assert that the component's sizes, counts and items agree with its content."""
    assert component.byte_order == order
    assert len(component.content) == 16 + component.num_items * component.item_bytes
    items = component.items()
    assert items.shape == (component.num_items,)
    assert items.tobytes() == bytes(component.content)[16:]
    content = bytes(component.content)
    assert component.frame_number == int.from_bytes(content[:4], order, signed=True)
    assert component.timestamp_us == int.from_bytes(content[4:12], order, signed=True)
    assert component.num_items == int.from_bytes(content[12:16], order)
    assert len(big_endian_content(component)) == len(content)


@settings(max_examples=examples(200))
@given(any_bodies, orders)
def test_any_bytes_are_a_consistent_frame_or_raise_frame_error(body: bytes, order: ByteOrder) -> None:
    split = split_or_none(body, order)
    if split is None:
        return
    assert len(split.components) + len(split.layout.unknown_types) == int.from_bytes(body[:4], order)
    for component in split.components:
        assert_consistent(component, order)
    known_bytes = 4 + sum(8 + len(component.content) for component in split.components)
    if split.layout.unknown_types:
        assert known_bytes + 8 * len(split.layout.unknown_types) + split.layout.num_extra_bytes <= len(body)
    else:
        assert known_bytes + split.layout.num_extra_bytes == len(body)


@settings(max_examples=examples(200))
@given(any_bodies, orders)
def test_any_bytes_make_sense_in_the_detected_byte_order_or_raise_frame_error(
    body: bytes, expected: ByteOrder
) -> None:
    makes_sense = {order: split_or_none(body, order) is not None for order in ("big", "little")}
    try:
        found = detect_byte_order(body, expected)
    except FrameError:
        assert not any(makes_sense.values())
    else:
        assert makes_sense[found]
        assert found == expected or not makes_sense[expected]


@settings(max_examples=examples(200))
@given(any_bodies, st.data(), orders)
def test_earlier_frames_do_not_change_how_a_frame_is_read(
    body: bytes, data: st.DataObject, order: ByteOrder
) -> None:
    reader = FrameReader(order)
    # The second body mostly differs in up to two bytes, which may or may not be raw of the layout.
    other = bytearray(body)
    for _ in range(data.draw(st.integers(0, 2)) if other else 0):
        other[data.draw(st.integers(0, len(other) - 1))] = data.draw(st.integers(0, 255))
    for each in (body, bytes(other), body):
        expected = split_or_none(each, order)
        try:
            read = reader.read(each)
        except FrameError:
            assert expected is None
        else:
            assert expected is not None
            assert read.layout.fields == expected.layout.fields
            assert read.layout.num_extra_bytes == expected.layout.num_extra_bytes
            assert read.components == expected.components
