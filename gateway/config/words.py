"""Words of error texts: values, lists of alternatives, hints at spelling; never a secret.

Secrets are the passwords and private keys in Zenoh's own keys. The path of a key's file is not a secret.
"""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

_MAX_ITEMS: Final = 8
"""The length of the longest list that is printed."""


def describe(value: object, *, show_items: bool = False) -> str:
    """Return a value as part of a sentence: printable, on one line, of limited length, without passwords.

    With ``show_items``, a short list of plain values is written as in YAML.
    """
    match value:
        case None | bool():
            return {None: "nothing", True: "true", False: "false"}[value]
        case Mapping():
            return "a mapping" if value else "an empty mapping"
        case list() | tuple():
            is_plain = not any(isinstance(item, Mapping | list | tuple) for item in value)
            if show_items and is_plain and 0 < len(value) <= _MAX_ITEMS:
                return f"[{', '.join(map(describe, value))}]"
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
    by_lower = {each.lower(): each for each in known}
    near = difflib.get_close_matches(str(word).lower()[:60], by_lower, n=1)
    return f" (did you mean {by_lower[near[0]]!r}?)" if near else ""


MASK: Final = "***"
"""The text that replaces a secret."""

_SECRET_KEY: Final = re.compile(r"(?:.*_)?(?:password|passphrase|secret|private_key_(?:pem|base64|raw))")
# Zenoh does not show what is below this key of a plugin's configuration in its admin space.
_PRIVATE: Final = "private"

# An endpoint may contain configuration: tls/lab:7447#connect_private_key_base64=…;….
_IN_ENDPOINT: Final = re.compile(r"((?:password|private_key_(?:raw|base64|pem))=)[^;\s\"'\])]+")
_IN_URL: Final = re.compile(r"(://[^/\s:@]*:)[^/\s@]+(?=@)")
_PEM: Final = re.compile(
    r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|$)", re.DOTALL
)

_Steps = tuple[str | int, ...]


def mask_secrets_in_text(text: str) -> str:
    """Return ``text`` with MASK for passwords in URLs, keys in endpoints, and keys in PEM format."""
    text = _PEM.sub(MASK, text)
    text = _IN_ENDPOINT.sub(rf"\g<1>{MASK}", text)
    return _IN_URL.sub(rf"\g<1>{MASK}", text)


def is_secret_key(key: object) -> bool:
    """Return whether the value of ``key`` is a secret, whatever the value is."""
    return isinstance(key, str) and (key == _PRIVATE or _SECRET_KEY.fullmatch(key.lower()) is not None)


def find_secrets(value: Any, location: _Steps = ()) -> Iterator[tuple[_Steps, str]]:
    """Yield the location of each secret in nested mappings and lists, and what to show instead."""
    match value:
        case Mapping():
            for key, item in value.items():
                if not is_secret_key(key):
                    yield from find_secrets(item, (*location, key))
                elif item is not None:
                    yield (*location, key), MASK
        case list() | tuple():
            for index, item in enumerate(value):
                yield from find_secrets(item, (*location, index))
        case str() if (masked := mask_secrets_in_text(value)) != value:
            yield location, masked


def replace_item(values: Any, location: _Steps, item: object) -> None:
    """Set what is at ``location`` in nested mappings and lists."""
    *steps, last = location
    for step in steps:
        values = values[step]
    values[last] = item
