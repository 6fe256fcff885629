"""One line of text or JSON for each message that a gateway publishes."""

import json
from collections.abc import Callable, Sequence
from typing import Any, Final

from gateway.errors import ProtocolError
from gateway.messages.decode import decode, to_json
from gateway.messages.summary import summarise, summarise_xml
from gateway.safe_text import safe_json, safe_text

_MAX_LINE_CHARACTERS: Final = 4000


def json_line(name: str, message: bytes) -> str:
    """Return a JSON object: the fields of the message, and ``name`` (the key or channel) as ``key``."""
    try:
        fields = to_json(decode(message))
    except ProtocolError as error:
        match _xml_or_json(message):
            case bytes() as xml:
                fields = {"xml": xml.decode("utf-8", "replace")}
            case dict() as json_object:
                fields = json_object
            case _:
                fields = {"error": str(error)}
    return safe_json(json.dumps({"key": name} | fields))


def text_line(name: str, message: bytes, units_of: Callable[[str, Any], Sequence[str]]) -> str:
    """Return a line of text: ``name`` (the key or channel) and a summary of the message.

    ``units_of`` returns the units of the items of a decoded message with this name.
    """
    try:
        decoded = decode(message)
        line = f"{name} {summarise(decoded, units_of(name, decoded))}"
    except ProtocolError as error:
        match _xml_or_json(message):
            case bytes() as xml:
                line = f"{name} {summarise_xml(xml)}"
            case dict() as json_object:
                line = f"{name} " + ", ".join(f"{key} {value}" for key, value in json_object.items())
            case _:
                line = f"{name}: {error}"
    return safe_text(line, _MAX_LINE_CHARACTERS)


def _xml_or_json(message: bytes) -> bytes | dict[str, Any] | None:
    """Return XML unchanged, or the object in a JSON text (both exist on Zenoh); None for other bytes."""
    if message.lstrip().startswith(b"<"):
        return message
    try:
        value = json.loads(message)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None
