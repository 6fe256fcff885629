"""Answers that need no server: schemas, messages as they are, parameters as JSON."""

from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import rtc3d

from gateway.messages.decode import message_type
from gateway.messages.json_text import json_text
from gateway.outputs.contract import Answer
from gateway.outputs.encodings import LCM, TEXT
from gateway.rtc3d.parameters import SECTIONS, Parameters


@cache
def schema_answer(name: str) -> Answer:
    """Return the ``.lcm`` text of a type for lcm-gen; the types that it contains come first."""
    texts = [
        (files("rtc3d") / f"{each}.lcm").read_text(encoding="utf-8") for each in _with_member_types(name)
    ]
    return Answer("\n".join(texts).encode(), TEXT)


def _with_member_types(name: str) -> list[str]:
    """Return the names of all types that a type contains, each once, and then its own."""
    names: dict[str, None] = {}
    for type_name in getattr(rtc3d, name).__typenames__:
        package, _, member = type_name.rpartition(".")
        if package:
            names |= dict.fromkeys(_with_member_types(member))
    return [*names, name]


def message_answer(message: bytes, attachment: Mapping[str, Any]) -> Answer:
    """Return a message of the gateway as it is published."""
    return Answer(message, f"{LCM};rtc3d.{message_type(message).__name__}", attachment)


def parameters_json(parameters: Parameters, section: str) -> bytes | None:
    """Return parameters as JSON with NaN as null: an object of all sections, or the object of one.

    Returns None if the parameters lack ``section``.
    """
    values = {key: section.of(parameters) for key, section in SECTIONS.items()}
    if section:
        return None if values[section] is None else json_text(values[section]).encode()
    return json_text({name: value for name, value in values.items() if value is not None}).encode()
