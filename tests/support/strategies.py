"""Hypothesis strategies for byte streams that are split or damaged."""

from itertools import pairwise

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

# Unusual values of a 32-bit field, in both byte orders.
_ODD_WORDS = [
    number.to_bytes(4, "big")[::step]
    for number in (0, 1, 7, 8, 9, 24, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
    for step in (1, -1)
]


@st.composite
def pieces_of(draw: DrawFn, stream: bytes) -> list[bytes]:
    """Return ``stream`` in pieces, split at random places. Pieces may be empty."""
    cuts = draw(st.lists(st.integers(0, len(stream)), max_size=12))
    return [stream[start:end] for start, end in pairwise([0, *sorted(cuts), len(stream)])]


@st.composite
def damaged(draw: DrawFn, valid: SearchStrategy[bytes]) -> bytes:
    """Return valid bytes with one to four faults: flipped bits, removed or inserted bytes, replaced words."""
    data = bytearray(draw(valid))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        match draw(st.sampled_from(["flip", "cut", "insert", "word"])):
            case "flip" if at < len(data):
                data[at] ^= draw(st.integers(1, 255))
            case "cut":
                del data[at : at + draw(st.integers(1, 64))]
            case "insert":
                data[at:at] = draw(st.binary(min_size=1, max_size=32))
            case "word":
                start = at - at % 4
                data[start : start + 4] = draw(st.sampled_from(_ODD_WORDS))
    return bytes(data)
