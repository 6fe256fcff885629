"""Words of error texts: values, lists of alternatives, hints at spelling."""

import difflib
from collections.abc import Iterable, Mapping

from gateway.config.secrets import mask_secrets_in_text


def describe(value: object) -> str:
    """Return a value as part of a sentence: printable, on one line, of limited length, without passwords."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "true" if value else "false"
        case Mapping():
            return "a mapping" if value else "an empty mapping"
        case list() | tuple():
            return "a list" if value else "an empty list"
        case str():
            text = mask_secrets_in_text(value)
            return repr(text if len(text) <= 60 else text[:60] + "…")
    return str(value)


def join_or(words: Iterable[str]) -> str:
    """Return "a, b or c"."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def spelling_hint(word: object, known: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" if ``word`` is similar to ``x``, a member of ``known``; else ""."""
    near = difflib.get_close_matches(str(word).lower()[:60], known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""
