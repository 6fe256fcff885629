"""XDF files as LabRecorder writes them (https://github.com/sccn/xdf/wiki/Specifications).

LabRecorder stores the XML that an inlet gives as the stream's header, the measured offsets of clocks, and the
samples with their time stamps. Nothing else is known to those who read the file.
"""

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple


class RecordedStream(NamedTuple):
    """A stream as an inlet gives it: XML, (time, offset) of its clock in s, and (time, values) of samples."""

    xml: str
    clock_offsets: Sequence[tuple[float, float]]
    samples: Sequence[tuple[float, Sequence[Any]]]


def write_xdf(file: Path, streams: Sequence[RecordedStream]) -> None:
    """Write streams of 32-bit floats or texts."""
    chunks = [_chunk(1, b'<?xml version="1.0"?><info><version>1.0</version></info>')]
    for number, stream in enumerate(streams, 1):
        identifier = struct.pack("<I", number)
        chunks.append(_chunk(2, identifier + stream.xml.encode()))
        for time_s, offset_s in stream.clock_offsets:
            chunks.append(_chunk(4, identifier + struct.pack("<dd", time_s, offset_s)))
        content = b"".join(_sample(*sample) for sample in stream.samples)
        chunks.append(_chunk(3, identifier + _number(len(stream.samples)) + content))
        footer = (
            f'<?xml version="1.0"?><info><first_timestamp>{stream.samples[0][0]}</first_timestamp>'
            f"<last_timestamp>{stream.samples[-1][0]}</last_timestamp>"
            f"<sample_count>{len(stream.samples)}</sample_count></info>"
        )
        chunks.append(_chunk(6, identifier + footer.encode()))
    file.write_bytes(b"XDF:" + b"".join(chunks))


def _chunk(tag: int, content: bytes) -> bytes:
    return _number(len(content) + 2) + struct.pack("<H", tag) + content


def _number(value: int) -> bytes:
    return b"\x04" + struct.pack("<I", value)


def _sample(time_s: float, values: Sequence[Any]) -> bytes:
    encoded = b"".join(
        _number(len(value.encode())) + value.encode() if isinstance(value, str) else struct.pack("<f", value)
        for value in values
    )
    return b"\x08" + struct.pack("<d", time_s) + encoded
