"""The server's XML in LCM messages, whose strings are text."""

import re
from typing import Final

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
