"""Whether a file is a C3D file, by its first bytes and by the sizes that it states.

A C3D file has blocks of 512 bytes. The first one is the header: byte 0 is the number, from 1, of the block
where the parameters begin, byte 1 is the key 0x50.
"""

import math
import struct
from typing import Final, NamedTuple

from gateway.safe_text import safe_text

HEAD_BYTES: Final = 2
PARAMETERS_END_BYTES: Final = 1024 * 1024
"""The parameters are within these first bytes: they begin in one of 255 blocks and have at most 255."""

_BLOCK_BYTES: Final = 512
_KEY: Final = 0x50
_FIRST_PARAMETER_BLOCK: Final = 2
_DATA_BLOCK_OFFSET: Final = 16
"""Where the header has the number of the block where the frames begin."""
_DEC, _BIG_ENDIAN = 85, 86  # of the types of processors; the usual one is 84, little-endian
_FORMATS: Final = {1: "B", 2: "H", 4: "f"}


class _Record(NamedTuple):
    """A parameter: the number of its group, its name, and where its values are."""

    group: int
    name: str
    element_bytes: int
    values_offset: int
    num_bytes: int


def problem_of_c3d(head: bytes, file_bytes: int) -> str:
    """Return why a file of ``file_bytes`` is no C3D file; "" if ``head``, its first HEAD_BYTES, is one's."""
    if file_bytes == 0:
        return "it is empty"
    if file_bytes < _BLOCK_BYTES:
        return f"it has {file_bytes} bytes, and the header of a C3D file has {_BLOCK_BYTES}"
    if head[1] != _KEY:
        return "its first bytes are not those of a C3D file"
    if not _FIRST_PARAMETER_BLOCK <= head[0] <= 1 + file_bytes // _BLOCK_BYTES:
        return "its parameters would begin outside of it"
    return ""


def problem_of_sizes(head: bytes, file_bytes: int) -> str:
    """Return which size stated in a C3D file cannot be true; "" if none.

    ``head`` is its first PARAMETERS_END_BYTES. Check it before a reader allocates what it states.
    """
    start = (head[0] - 1) * _BLOCK_BYTES
    if len(head) < start + 4:
        return "it ends before its parameters"
    processor = head[start + 3]
    order = ">" if processor == _BIG_ENDIAN else "<"
    (data_block,) = struct.unpack_from(f"{order}H", head, _DATA_BLOCK_OFFSET)
    data_start = max(data_block - 1, 0) * _BLOCK_BYTES
    stated_end = max(data_start, start + head[start + 2] * _BLOCK_BYTES)
    end = stated_end if start < stated_end <= file_bytes else file_bytes
    groups, records = _records(head[:end], start + 4, order)
    numbers: dict[str, float] = {}
    for record in records:
        name = f"{groups.get(record.group, record.group)}:{record.name}"
        if record.values_offset + record.num_bytes > end:
            return f"its parameter {safe_text(name)} would have {record.num_bytes} bytes, more than it has"
        if record.num_bytes == record.element_bytes in _FORMATS and record.values_offset + 4 <= len(head):
            value_format = order + _FORMATS[record.element_bytes]
            (numbers[name],) = struct.unpack_from(value_format, head, record.values_offset)
    rates_hz = numbers.get("ANALOG:RATE", 0.0), numbers.get("POINT:RATE", 0.0)
    ratio = rates_hz[0] / rates_hz[1] if processor != _DEC and rates_hz[1] > 0 else 1.0
    samples = ratio if math.isfinite(ratio) else 1.0
    values = 4 * numbers.get("POINT:USED", 0) + numbers.get("ANALOG:USED", 0) * samples
    room = max(file_bytes - data_start, 0)
    if 2 * values > room:
        return f"each of its frames would have at least {2 * values:.0f} bytes, and it has {room} for all"
    return ""


def _records(head: bytes, position: int, order: str) -> tuple[dict[int, str], list[_Record]]:
    """Return the names of the groups by their numbers, and all parameters, as far as they can be read."""
    groups: dict[int, str] = {}
    records = []
    while position + 2 <= len(head):
        length, group = struct.unpack_from("bb", head, position)
        name = head[position + 2 : position + 2 + abs(length)].decode("latin-1").strip().upper()
        at = position + 2 + abs(length)
        if length == 0 or group == 0 or at + 4 > len(head):
            break
        (offset,) = struct.unpack_from(f"{order}H", head, at)
        if group < 0:
            groups[-group] = name
        else:
            element_bytes = abs(struct.unpack_from("b", head, at + 2)[0])
            sizes = head[at + 4 : at + 4 + head[at + 3]]
            values_offset = at + 4 + len(sizes)
            num_bytes = element_bytes * math.prod(sizes)
            records.append(_Record(group, name, element_bytes, values_offset, num_bytes))
        if offset == 0:
            break
        position = at + offset
    return groups, records
