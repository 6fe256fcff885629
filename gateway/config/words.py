"""Words of error texts: values, lists of alternatives, hints at spelling; never a secret.

Secrets are the passwords and private keys in Zenoh's own keys. The path of a key's file is not a secret.
"""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

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


def is_secret_key(key: object) -> bool:
    """Return whether the value of ``key`` is a secret, whatever the value is."""
    return isinstance(key, str) and (key == _PRIVATE or _SECRET_KEY.fullmatch(key.lower()) is not None)


def find_secrets(value: Any, location: _Steps = ()) -> Iterator[tuple[_Steps, Any]]:
    """Yield each secret in nested mappings and lists, with its location."""
    match value:
        case Mapping():
            for key, item in value.items():
                if is_secret_key(key):
                    if item is not None:
                        yield (*location, key), item
                else:
                    yield from find_secrets(item, (*location, key))
        case list() | tuple():
            for index, item in enumerate(value):
                yield from find_secrets(item, (*location, index))
        case str() if mask_secrets_in_text(value) != value:
            yield location, value


def file_key_for(key: object) -> str:
    """Return the key for the path of the file instead of its content, such as connect_private_key.

    Returns "" if there is no such key.
    """
    match str(key).rpartition("_"):
        case (stem, "_", "base64"):
            return stem
        case (stem, "_", "pem"):
            return f"{stem}_file"
    return ""


def mask_secrets(value: Any) -> Any:
    """Return a copy of nested mappings and lists with MASK for every secret."""
    match value:
        case Mapping():
            return {
                key: MASK if is_secret_key(key) and item is not None else mask_secrets(item)
                for key, item in value.items()
            }
        case list() | tuple():
            return [mask_secrets(item) for item in value]
        case str():
            return mask_secrets_in_text(value)
    return value


def mask_secrets_in_text(text: str) -> str:
    """Return ``text`` with MASK for passwords in URLs, keys in endpoints, and keys in PEM format."""
    text = _PEM.sub(MASK, text)
    text = _IN_ENDPOINT.sub(rf"\g<1>{MASK}", text)
    return _IN_URL.sub(rf"\g<1>{MASK}", text)
