"""Text from servers, peers and unknown publishers, made safe for a log, a terminal or a status message."""

import re
from typing import Final

MAX_CHARACTERS: Final = 500
"""The usual limit of a text that contains such text."""

_MAX_QUOTED_CHARACTERS: Final = 40

_NOT_ASCII: Final = re.compile(r"[^\x20-\x7e]")


def safe_text(text: str, max_characters: int = MAX_CHARACTERS) -> str:
    r"""Return ``text`` as one line of at most ``max_characters``, with control characters escaped.

    Longer text is cut, with "…" at the end. Python's ``repr`` escapes the same characters: those that could
    forge a line of a log or control a terminal, and those that UTF-8 cannot encode. They are control
    characters (C0 and C1, with NUL, line ends and ESC), line and paragraph separators, directional overrides
    and other invisible characters, and lone surrogates. Backslashes stay, so a text that is escaped already
    does not change.
    """
    # Cut first: the text may be long. Escaping makes it longer, so cut once more.
    cut = text[: max_characters + 1]
    if not cut.isprintable():
        cut = "".join(each if each.isprintable() else repr(each)[1:-1] for each in cut)
    return cut if len(cut) <= max_characters else cut[: max_characters - 1] + "…"


def safe_lines(text: str, max_characters: int = 20_000) -> str:
    """Return ``text`` of several lines, such as a traceback, each escaped as by ``safe_text``."""
    cut = text if len(text) <= max_characters else text[: max_characters - 1] + "…"
    return "\n".join(safe_text(line, max_characters) for line in cut.split("\n"))


def quoted(text: str, max_characters: int = _MAX_QUOTED_CHARACTERS) -> str:
    """Return ``text`` as a quoted part of a sentence: escaped as by ``repr``, and cut with "…"."""
    return repr(text if len(text) <= max_characters else text[:max_characters] + "…")


def safe_json(json_text: str) -> str:
    r"""Return ``json_text`` with the characters that ``safe_text`` escapes as \u escapes.

    The values stay the same. Line ends stay too: in JSON they are between values only.
    """
    return _NOT_ASCII.sub(_json_escaped, json_text)


def _json_escaped(match: re.Match[str]) -> str:
    character = match[0]
    if character == "\n" or character.isprintable():
        return character
    # Characters outside the basic plane are two surrogates in JSON.
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))
