"""Finding and masking the secrets in a configuration.

Secrets are the passwords and private keys in Zenoh's own keys. The path of a key's file is not a secret.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

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
