"""Values and texts that come from many places, moved into the range of a message's field."""

import math
import re
import struct
from functools import cache
from typing import Any, Final

from gateway.runtime.safe_text import safe_text

_MAX_BITS: Final = {"int8_t": 7, "int16_t": 15, "int32_t": 31, "int64_t": 63}
_MAX_FLOAT: Final = 3.4028234663852886e38


def encode_within_limits(message: Any) -> bytes:
    """Return an LCM message encoded with the nearest values that its fields can have; it is changed.

    Integers and floats are moved into their range, and texts are those of ``safe_text``. So no number that a
    server makes the gateway compute, and no text, prevents its status.
    """
    _limit(message, with_numbers=False)
    encoded: bytes
    try:
        encoded = message.encode()
    except (struct.error, OverflowError):  # rare, and checking each number would take most of the time
        _limit(message, with_numbers=True)
        encoded = message.encode()
    return encoded


@cache
def _fields(message_type: type[Any], *, with_numbers: bool) -> list[tuple[str, str]]:
    """Return the names and types of the fields to limit."""
    fields = zip(message_type.__slots__, message_type.__typenames__, strict=True)
    others = {"boolean", "byte"} if with_numbers else {"boolean", "byte", "float", "double", *_MAX_BITS}
    return [field for field in fields if field[1] not in others]


def _limit(message: Any, *, with_numbers: bool) -> None:
    for name, type_name in _fields(message.__class__, with_numbers=with_numbers):
        value = getattr(message, name)
        if not isinstance(value, list):
            setattr(message, name, _limited(value, type_name, with_numbers=with_numbers))
        elif value:
            limited = [_limited(item, type_name, with_numbers=with_numbers) for item in value]
            setattr(message, name, limited)


def _limited(value: Any, type_name: str, *, with_numbers: bool) -> Any:
    if type_name == "string":
        return safe_text(value)
    if type_name in _MAX_BITS:
        end = 1 << _MAX_BITS[type_name]
        return max(-end, min(value, end - 1))
    if type_name in {"float", "double"}:
        largest = _MAX_FLOAT if type_name == "float" else math.inf
        try:
            number = float(value)
        except OverflowError:  # of an integer beyond all floats
            number = math.inf if value > 0 else -math.inf
        # Infinity and NaN stay, because IEEE 754 has them in both sizes.
        return max(-largest, min(number, largest)) if math.isfinite(number) else number
    _limit(value, with_numbers=with_numbers)
    return value


_DECLARED_ENCODING: Final = re.compile(r"""\s*<\?xml[^>]*\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")


def xml_text(xml: bytes) -> str:
    """Return XML as text (UTF-8, otherwise Latin-1), without the NULs at its end (field note 9)."""
    body = xml.rstrip(b"\0")
    try:
        return body.decode()
    except UnicodeDecodeError:
        return body.decode("latin-1")


def xml_bytes(text: str) -> bytes:
    """Return the XML of a ``parameters_t`` or ``parameters_reply_t`` as the server sent it.

    The gateway reads XML that is not UTF-8 as Latin-1 to make it text. If the XML declares such an encoding,
    it has to be in it again before it is parsed. Other XML is UTF-8.
    """
    declared = _DECLARED_ENCODING.match(text)
    if declared and declared[1].lower() not in ("utf-8", "utf8"):
        try:
            return text.encode("latin-1")
        except UnicodeEncodeError:
            pass
    return text.encode(errors="replace")
