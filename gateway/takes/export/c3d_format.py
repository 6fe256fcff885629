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

from gateway.errors import TakeError

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
Numbers: TypeAlias = npt.NDArray[Any]


class Parameter(NamedTuple):
    """One parameter of a group: a list of texts, or an array of integers (16 bits) or of floats (32 bits).

    An array has the dimensions in the order of the C3D user guide, the first one changing fastest.
    """

    name: str
    values: Texts | Numbers


Groups: TypeAlias = dict[str, list[Parameter]]


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


def text_lists(name: str, texts: Texts) -> list[Parameter]:
    """Return a list of texts as NAME, and NAME2, NAME3, … if they are more than 255."""
    return [
        Parameter(_numbered(name, part), texts[start : start + MAX_LIST]) for part, start in _parts(texts)
    ]


def number_lists(name: str, numbers: Numbers) -> list[Parameter]:
    """Return a list of numbers as NAME, and NAME2, NAME3, … if they are more than 255."""
    return [
        Parameter(_numbered(name, part), numbers[start : start + MAX_LIST]) for part, start in _parts(numbers)
    ]


def standard_groups(shape: Shape, point_units: Texts) -> Groups:
    """Return POINT, ANALOG and TRIAL with what the shape says; labels and the like are still missing."""
    analog_rate_hz = shape.rate_hz * shape.samples_per_frame if shape.num_channels else 0.0
    groups: Groups = {
        "POINT": [
            Parameter("USED", _integer(shape.num_points)),
            Parameter("SCALE", _float(-shape.scale)),
            Parameter("RATE", _float(shape.rate_hz)),
            Parameter("DATA_START", _integer(0)),
            Parameter("FRAMES", _integer(min(shape.num_frames, MAX_WORD))),
            Parameter("UNITS", point_units),
        ],
        "ANALOG": [
            Parameter("USED", _integer(shape.num_channels)),
            Parameter("GEN_SCALE", _float(1.0)),
            Parameter("RATE", _float(analog_rate_hz)),
            Parameter("FORMAT", ["SIGNED"]),
            Parameter("BITS", _integer(16)),
            *number_lists("SCALE", np.ones(shape.num_channels, np.float32)),
            *number_lists("OFFSET", np.zeros(shape.num_channels, np.int16)),
        ],
        "TRIAL": [
            Parameter("ACTUAL_START_FIELD", _two_words(1)),
            Parameter("ACTUAL_END_FIELD", _two_words(shape.num_frames)),
            Parameter("CAMERA_RATE", _float(shape.rate_hz)),
        ],
    }
    if shape.num_frames > MAX_WORD:
        groups["POINT"].append(Parameter("LONG_FRAMES", _float(shape.num_frames)))
    return groups


def encode_head(shape: Shape, groups: Groups) -> bytes:
    """Return everything before the frames. Raises TakeError if the parameters are too large for the
    format."""
    num_blocks = -(-len(_encode_groups(groups, 0)) // BLOCK_BYTES)
    if num_blocks > _MAX_PARAMETER_BLOCKS:
        raise TakeError("the labels do not fit into a C3D file; export to .csv instead")
    data_block = 2 + num_blocks
    parameters = _encode_groups(groups, data_block).ljust(num_blocks * BLOCK_BYTES, b"\0")
    return _encode_header(shape, data_block) + parameters


def _encode_header(shape: Shape, data_block: int) -> bytes:
    header = bytearray(BLOCK_BYTES)
    samples_per_frame = shape.samples_per_frame if shape.num_channels else 0
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
    return bytes(header)


def _encode_groups(groups: Groups, data_block: int) -> bytes:
    records = []
    for number, (name, parameters) in enumerate(groups.items(), start=1):
        records.append(_record(name, -number, b""))
        for parameter in parameters:
            values = _integer(data_block) if parameter.name == "DATA_START" else parameter.values
            records.append(_record(parameter.name, number, _encode_values(values)))
    body = b"".join(records) + b"\0\0"
    num_blocks = -(-(4 + len(body)) // BLOCK_BYTES)
    return struct.pack("<BBBB", 1, 0x50, min(num_blocks, 255), _INTEL) + body


def _record(name: str, number: int, content: bytes) -> bytes:
    """Return a group or a parameter, with an empty description; the offset counts from itself."""
    encoded = name.encode("ascii")
    return (
        struct.pack("<bb", len(encoded), number)
        + encoded
        + struct.pack("<H", 3 + len(content))
        + content
        + b"\0"
    )


def _encode_values(values: Texts | Numbers) -> bytes:
    if isinstance(values, np.ndarray):
        is_float = values.dtype.kind == "f"
        data = values.astype("<f4" if is_float else "<i2").tobytes(order="F")
        sizes = values.shape
        kind = 4 if is_float else 2
    else:
        encoded = [encode_text(text) for text in values]
        width = max(map(len, encoded), default=0)
        data = b"".join(text.ljust(width) for text in encoded)
        sizes = (width, len(encoded))
        kind = -1
    return struct.pack("<bB", kind, len(sizes)) + bytes(sizes) + data


def encode_text(text: str, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Return a text as UTF-8 of at most ``max_bytes``, cut between two characters."""
    return text.encode(errors="replace")[:max_bytes].decode(errors="ignore").encode()


def _parts(values: Texts | Numbers) -> list[tuple[int, int]]:
    return list(enumerate(range(0, max(len(values), 1), MAX_LIST), start=1))


def _numbered(name: str, part: int) -> str:
    return name if part == 1 else f"{name}{part}"


def _integer(value: int) -> Numbers:
    return np.array(value, np.uint16)


def _float(value: float) -> Numbers:
    return np.array(value, np.float32)


def _two_words(value: int) -> Numbers:
    return np.array([value & MAX_WORD, value >> 16], np.uint16)
