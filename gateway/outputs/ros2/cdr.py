"""Encoding values in CDR, the Common Data Representation of the OMG, as ROS 2 uses it: little-endian.

Four bytes say so (ENCAPSULATION). Each value is aligned to its own size, counted from the end of these four
bytes. A string is its length with the final NUL (uint32), its UTF-8 bytes, and the NUL. A sequence is its
length (uint32) and its items.
"""

import struct
from collections.abc import Iterable
from typing import Final, Self

ENCAPSULATION: Final = b"\x00\x01\x00\x00"
"""The first bytes of every message: CDR version 1, little-endian, no options."""

MAX_STAMP_S: Final = (1 << 31) - 1
"""The seconds of builtin_interfaces/Time are an int32."""

_UINT32: Final = struct.Struct("<I")
_STAMP: Final = struct.Struct("<iI")


def padding(offset: int, alignment: int) -> bytes:
    """Return the zeros that align a value which would be at ``offset``."""
    return bytes(-offset % alignment)


def stamp(utime: int) -> bytes:
    """Return a builtin_interfaces/Time for a time in µs since the Unix epoch, moved into its range."""
    seconds, microseconds = divmod(utime, 1_000_000)
    return _STAMP.pack(max(-MAX_STAMP_S - 1, min(seconds, MAX_STAMP_S)), 1000 * microseconds)


class CdrWriter:
    """Appends values, with the padding that each of them needs.

    ``offset`` is where the first value will be in the message, not counting ENCAPSULATION, if only a part of
    a message is written. ``content`` is what has been written, from there on.
    """

    def __init__(self, offset: int = 0) -> None:
        self._first = offset
        self._parts: list[bytes] = []
        self._offset = offset

    @property
    def content(self) -> bytes:
        """The bytes written so far."""
        return b"".join(self._parts)

    def raw(self, content: bytes) -> Self:
        """Append bytes as they are; the caller knows their alignment."""
        self._parts.append(content)
        self._offset += len(content)
        return self

    def align(self, alignment: int) -> Self:
        """Append zeros until the next value is aligned."""
        return self.raw(padding(self._offset, alignment))

    def uint8(self, *values: int) -> Self:
        """Append numbers of one byte; a bool is one of them."""
        return self.raw(bytes(values))

    def uint32(self, *values: int) -> Self:
        """Append numbers of four bytes."""
        self.align(4)
        for value in values:
            self.raw(_UINT32.pack(value))
        return self

    def string(self, text: str) -> Self:
        """Append a text. A NUL would end it early, so it becomes a replacement character."""
        encoded = text.replace("\0", "\ufffd").encode(errors="replace")
        return self.uint32(len(encoded) + 1).raw(encoded).uint8(0)

    def strings(self, texts: Iterable[str]) -> Self:
        """Append texts one after the other, without their number."""
        for text in texts:
            self.string(text)
        return self
