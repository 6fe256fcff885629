"""The C3D format: a header, parameters in groups, and frames of 32-bit floats, all little-endian.

The format is that of the C3D user guide (c3d.org), with what other programs write beyond its limits: more
than 255 labels continue in LABELS2, LABELS3, …; the number of more than 65535 frames is in
TRIAL:ACTUAL_END_FIELD.

The file is written here and not by ezc3d, because ezc3d keeps the whole recording in memory (4 MB for each
second of 55 markers and 69 analog channels), does not report a full disk, and cuts files at 65535 frames.
"""

import struct
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

BLOCK_BYTES: Final = 512
MAX_LIST: Final = 255
"""The highest number of values in one dimension of a parameter; a longer list continues in others."""
MAX_TEXT_BYTES: Final = 120
"""Texts are cut to this: 255 of them must fit into one parameter, whose size is a signed 16-bit number."""
MAX_WORD: Final = 65535
MAX_FRAMES: Final = 2**24
"""A float counts frames exactly up to here: 23 hours at 200 Hz."""

_MAX_PARAMETER_BLOCKS: Final = 255
_INTEL: Final = 84
_HEADER: Final = struct.Struct("<BBHHHHHfHHf")
_FOUR_CHARACTER_EVENTS: Final = 0x3039
_FOUR_CHARACTER_EVENTS_OFFSET: Final = 149 * 2

Texts: TypeAlias = Sequence[str]
Values: TypeAlias = Texts | npt.NDArray[Any] | int | float
"""The values of a parameter: texts, or numbers: 16 bits if they are integers, and 32 bits if they are floats.

An array has the dimensions in the order of the C3D user guide, the first one changing fastest.
"""

Group: TypeAlias = dict[str, Values]
Groups: TypeAlias = dict[str, Group]


class Shape(NamedTuple):
    """The sizes and rates of a file. There are ``samples_per_frame`` analog samples in each frame.

    ``scale`` is the step of the residuals, in the unit of the points.
    """

    num_points: int
    num_channels: int
    samples_per_frame: int
    num_frames: int
    rate_hz: float
    scale: float


def rate_in_float32(rate_hz: float, samples_per_frame: int) -> float:
    """Return the nearest rate whose product with ``samples_per_frame`` is exact in 32 bits.

    Readers divide ANALOG:RATE by POINT:RATE and need exactly ``samples_per_frame``.
    """
    bits = max(samples_per_frame - 1, 0).bit_length()
    mantissa, exponent = np.frexp(np.float32(rate_hz))
    digits = 2.0 ** (24 - bits)
    return float(np.ldexp(np.round(mantissa * digits) / digits, exponent))


def lists(name: str, values: Texts | npt.NDArray[Any]) -> Group:
    """Return a list of texts or numbers as NAME, and NAME2, NAME3, … if they are more than 255."""
    parts = enumerate(range(0, max(len(values), 1), MAX_LIST), start=1)
    return {name if part == 1 else f"{name}{part}": values[at : at + MAX_LIST] for part, at in parts}


def standard_groups(shape: Shape, point_unit: str) -> Groups:
    """Return POINT, ANALOG and TRIAL with what the shape says; labels and the like are still missing."""
    return {
        "POINT": {
            "USED": shape.num_points,
            "SCALE": -shape.scale,
            "RATE": shape.rate_hz,
            "DATA_START": 0,
            "FRAMES": min(shape.num_frames, MAX_WORD),
            "UNITS": [point_unit],
            **({"LONG_FRAMES": float(shape.num_frames)} if shape.num_frames > MAX_WORD else {}),
        },
        "ANALOG": {
            "USED": shape.num_channels,
            "GEN_SCALE": 1.0,
            "RATE": shape.rate_hz * shape.samples_per_frame if shape.num_channels else 0.0,
            "FORMAT": ["SIGNED"],
            "BITS": 16,
            **lists("SCALE", np.ones(shape.num_channels)),
            **lists("OFFSET", np.zeros(shape.num_channels, int)),
        },
        "TRIAL": {
            "ACTUAL_START_FIELD": np.array([1, 0]),
            "ACTUAL_END_FIELD": np.array([shape.num_frames & MAX_WORD, shape.num_frames >> 16]),
            "CAMERA_RATE": shape.rate_hz,
        },
    }


def encode_head(shape: Shape, groups: Groups) -> bytes | None:
    """Return everything before the frames, with POINT:DATA_START; None if the parameters are too large."""
    num_blocks = -(-len(_encode_groups(groups)) // BLOCK_BYTES)
    if num_blocks > _MAX_PARAMETER_BLOCKS:
        return None
    data_block = groups["POINT"]["DATA_START"] = 2 + num_blocks
    samples_per_frame = shape.samples_per_frame if shape.num_channels else 0
    header = bytearray(BLOCK_BYTES)
    _HEADER.pack_into(
        header,
        0,
        2,  # the block of the parameters
        0x50,
        shape.num_points,
        shape.num_channels * samples_per_frame,
        1,  # the number of the first frame
        min(shape.num_frames, MAX_WORD),
        10,  # the largest gap that may be interpolated, in frames
        -shape.scale,  # negative: the points are floats
        data_block,
        samples_per_frame,
        shape.rate_hz,
    )
    struct.pack_into("<H", header, _FOUR_CHARACTER_EVENTS_OFFSET, _FOUR_CHARACTER_EVENTS)
    return bytes(header) + _encode_groups(groups).ljust(num_blocks * BLOCK_BYTES, b"\0")


def _encode_groups(groups: Groups) -> bytes:
    records = []
    for number, (name, parameters) in enumerate(groups.items(), start=1):
        records.append(_record(name, -number, b""))
        records += [_record(each, number, _encode_values(values)) for each, values in parameters.items()]
    body = b"".join(records) + b"\0\0"
    num_blocks = -(-(4 + len(body)) // BLOCK_BYTES)
    return struct.pack("<BBBB", 1, 0x50, min(num_blocks, 255), _INTEL) + body


def _record(name: str, number: int, content: bytes) -> bytes:
    """Return a group or a parameter, with an empty description; the offset counts from itself."""
    head = struct.pack("<bb", len(name), number) + name.encode("ascii")
    return head + struct.pack("<H", 3 + len(content)) + content + b"\0"


def _encode_values(values: Values) -> bytes:
    if isinstance(values, Sequence):
        encoded = [encode_text(text) for text in values]
        width = max(map(len, encoded), default=0)
        data = b"".join(text.ljust(width) for text in encoded)
        return struct.pack("<bBBB", -1, 2, width, len(encoded)) + data
    numbers = np.asarray(values)
    kind, dtype = (4, "<f4") if numbers.dtype.kind == "f" else (2, "<i2")
    sizes = struct.pack("<bB", kind, numbers.ndim) + bytes(numbers.shape)
    return sizes + numbers.astype(dtype).tobytes(order="F")


def encode_text(text: str) -> bytes:
    """Return a text as UTF-8 of at most MAX_TEXT_BYTES, cut between two characters."""
    return text.encode(errors="replace")[:MAX_TEXT_BYTES].decode(errors="ignore").encode()
