"""JSON texts of LCM objects and parameters, written in Python so that other threads can run meanwhile.

``json.dumps`` keeps all other threads waiting from the first to the last byte: 24 ms for a frame of 10,000
markers, in which no frame is published. It is not faster either: for 1000 markers, ``to_json`` and
``json.dumps`` together take 3.7 ms, and ``json_text`` takes 3.2 ms.
"""

from functools import cache
from json.encoder import encode_basestring
from typing import Any, Final

MAX_JSON_SOURCE_BYTES: Final = 1024 * 1024
"""Longer messages (65,000 markers) are not converted: the text would have six times as many bytes."""


def json_text(value: Any) -> str:
    """Return an LCM object, a dataclass with slots, or a list, dict or value of them, as compact JSON.

    NaN and infinity become null.
    """
    kind: Any = type(value)
    if kind is float:
        text = repr(value) if value - value == 0 else "null"
    elif kind is int:
        text = repr(value)
    elif kind is str:
        text = encode_basestring(value)
    elif kind is list or kind is tuple:
        text = f"[{','.join([json_text(item) for item in value])}]"
    elif kind is dict:
        items = [f"{encode_basestring(name)}:{json_text(item)}" for name, item in value.items()]
        text = f"{{{','.join(items)}}}"
    elif value is None or kind is bool:
        text = {None: "null", True: "true", False: "false"}[value]
    else:
        items = [key + json_text(getattr(value, name)) for name, key in _fields(kind)]
        text = f"{{{','.join(items)}}}"
    return text


@cache
def _fields(kind: Any) -> list[tuple[str, str]]:
    """Return the name of each field of a type, as it is and as a key in JSON."""
    return [(name, f"{encode_basestring(name)}:") for name in kind.__slots__]
