"""The encodings of answers to peers, as Zenoh names them, and JSON for them."""

import json
from typing import Any, Final

XML: Final = "application/xml"
JSON: Final = "application/json"
C3D: Final = "application/octet-stream"
TEXT: Final = "text/plain"
LCM: Final = "application/x-lcm"
"""The encoding of every message; its schema is the LCM type: ``application/x-lcm;rtc3d.markers_t``."""


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as compact JSON in UTF-8; raises ValueError for numbers that JSON lacks."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
