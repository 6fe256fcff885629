"""Words of error texts: values, lists of alternatives, hints at spelling."""

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from gateway.config.secrets import mask_secrets_in_text

_MAX_ITEMS: Final = 8
"""The length of the longest list that is printed."""


def describe(value: object, *, show_items: bool = False) -> str:
    """Return a value as part of a sentence: printable, on one line, of limited length, without passwords.

    With ``show_items``, a short list of plain values is written as in YAML.
    """
    match value:
        case None:
            return "nothing"
        case bool():
            return "true" if value else "false"
        case Mapping():
            return "a mapping" if value else "an empty mapping"
        case list() | tuple():
            return _describe_list(value, show_items=show_items)
        case str():
            text = mask_secrets_in_text(value)
            return repr(text if len(text) <= 60 else text[:60] + "…")
    return str(value)


def _describe_list(values: Sequence[object], *, show_items: bool) -> str:
    if not values:
        return "an empty list"
    is_plain = not any(isinstance(value, Mapping | list | tuple) for value in values)
    if show_items and is_plain and len(values) <= _MAX_ITEMS:
        return f"[{', '.join(map(describe, values))}]"
    return "a list"


def join_or(words: Iterable[str]) -> str:
    """Return "a, b or c"."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def spelling_hint(word: object, known: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" if ``word`` is similar to ``x``, a member of ``known``; else ""."""
    near = difflib.get_close_matches(str(word).lower()[:60], known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""
