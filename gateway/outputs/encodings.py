"""The encodings of messages and answers, as Zenoh names them, and a JSON encoder for answers."""

import json
from typing import Any, Final

XML: Final = "application/xml"
JSON: Final = "application/json"
C3D: Final = "application/octet-stream"
LOG: Final = "application/octet-stream"
TEXT: Final = "text/plain"
LCM: Final = "application/x-lcm"
"""The encoding of every message; its schema is the LCM type: ``application/x-lcm;rtc3d.markers_t``."""


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as compact JSON in UTF-8. Raises ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
