"""Values and texts that come from many places, moved into the range of a message's field."""

import math
import re
from typing import Any, Final

from gateway.logs.safe_text import safe_text

_MAX_BITS: Final = {"int8_t": 7, "int16_t": 15, "int32_t": 31, "int64_t": 63}
_MAX_FLOAT: Final = 3.4028234663852886e38


def encode_within_limits(message: Any) -> bytes:
    """Return an LCM message encoded with the nearest values that its fields can have; it is changed.

    Integers and floats are moved into their range, and texts are those of ``safe_text``. So no number that a
    server makes the gateway compute, and no text, prevents its status.
    """
    _limit(message)
    encoded: bytes = message.encode()
    return encoded


def _limit(message: Any) -> None:
    for name, type_name in zip(message.__slots__, message.__typenames__, strict=True):
        value = getattr(message, name)
        if isinstance(value, list):
            setattr(message, name, [_limited(item, type_name) for item in value])
        else:
            setattr(message, name, _limited(value, type_name))


def _limited(value: Any, type_name: str) -> Any:
    if type_name in _MAX_BITS:
        return _limited_integer(value, 1 << _MAX_BITS[type_name])
    match type_name:
        case "string":
            return safe_text(value)
        case "float" | "double":
            return _limited_float(value, _MAX_FLOAT if type_name == "float" else math.inf)
        case "boolean" | "byte":
            return value
    _limit(value)
    return value


def _limited_integer(value: int, end: int) -> int:
    return max(-end, min(value, end - 1))


def _limited_float(value: float, largest: float) -> float:
    """Return the nearest float; infinity and NaN stay, because IEEE 754 has them in both sizes."""
    try:
        number = float(value)
    except OverflowError:  # of an integer beyond all floats
        number = math.inf if value > 0 else -math.inf
    return max(-largest, min(number, largest)) if math.isfinite(number) else number


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
