"""What can be asked about a source, and the forms of answers: no I/O, no waiting."""

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict
from importlib.resources import files
from typing import Any, Final, Literal, NamedTuple

from gateway.decode import MESSAGE_TYPES_BY_NAME, decode, to_json
from gateway.errors import QueryError
from gateway.rtc3d.commands import SECTIONS
from gateway.rtc3d.components import BY_KEY, WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import Parameters

XML: Final = "application/xml"
JSON: Final = "application/json"
C3D: Final = "application/octet-stream"
TEXT: Final = "text/plain"
LCM: Final = "application/x-lcm"

Parts = tuple[str, ...]
"""A key below PREFIX/SOURCE/, cut at the slashes: ("parameters", "3d")."""

_OPTIONS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "parameters": {"format": ("xml", "json"), "fresh": ("true", "false"), "stale": ("ok",)},
    "component": {"format": ("lcm", "json")},
    "status": {"format": ("lcm", "json")},
    "c3d": {},
    "schema": {},
    "recording": {"set": ("start", "stop")},
}
"""The options that each kind of key takes, with the values that each accepts."""


class Question(NamedTuple):
    """One question about one source. ``kind`` says which of the other fields mean something.

    ``name`` is the section ("" for all), the component's key, or the type; ``set`` is start or stop.
    """

    kind: Literal["parameters", "component", "status", "c3d", "schema", "recording"]
    name: str = ""
    as_json: bool = False
    fresh: bool = False
    stale_ok: bool = False
    set: str = ""


class Answer(NamedTuple):
    """The answer's bytes, its Zenoh encoding, and what goes with it: ages in s, names, session."""

    payload: bytes
    encoding: str
    attachment: Mapping[str, Any] = {}


def known_keys(components: Collection[ComponentType]) -> list[Parts]:
    """Return every key that can be asked of a source with these components configured."""
    return [
        ("parameters",),
        *(("parameters", section) for section in SECTIONS),
        *((component.key,) for component in WIRE_ORDER if component in components),
        ("status",),
        ("c3d",),
        ("recording",),
        *(("schema", name) for name in MESSAGE_TYPES_BY_NAME),
    ]


def parse_question(
    parts: Parts, options: Mapping[str, str], components: Collection[ComponentType]
) -> Question:
    """Return the question that a key and its selector's options ask.

    Raises QueryError, listing what is accepted, for an unknown key, section, component that is not
    configured, option or value.
    """
    kind, name = _kind_and_name(parts, components)
    accepted = _OPTIONS[kind]
    for option, value in options.items():
        if option not in accepted:
            known = ", ".join(f"{key}={'|'.join(values)}" for key, values in accepted.items())
            raise QueryError(f"unknown option {option!r} of {kind}; accepted: {known or 'none'}")
        if value not in accepted[option]:
            raise QueryError(f"{option}={value!r} is not accepted; accepted: {', '.join(accepted[option])}")
    if kind == "recording" and "set" not in options:
        raise QueryError("recording takes set=start or set=stop")
    return Question(
        kind,  # type: ignore[arg-type]  # one of _OPTIONS' keys, which are those of Question.kind
        name,
        as_json=options.get("format") == "json",
        fresh=options.get("fresh") == "true",
        stale_ok="stale" in options,
        set=options.get("set", ""),
    )


def fitting_options(parts: Parts, options: Mapping[str, str]) -> dict[str, str]:
    """Return the options that mean something to the key, for a selector that asks of many keys."""
    kind = parts[0] if parts[0] in _OPTIONS else "component"
    return {name: value for name, value in options.items() if value in _OPTIONS[kind].get(name, ())}


def _kind_and_name(parts: Parts, components: Collection[ComponentType]) -> tuple[str, str]:
    match parts:
        case ("parameters",):
            return "parameters", ""
        case ("parameters", section) if section in SECTIONS:
            return "parameters", section
        case ("parameters", section):
            raise QueryError(f"unknown section {section!r}; accepted: {', '.join(SECTIONS)}")
        case (key,) if key in BY_KEY:
            if BY_KEY[key] not in components:
                configured = ", ".join(component.key for component in WIRE_ORDER if component in components)
                raise QueryError(f"component {key!r} is not configured for this source; it has {configured}")
            return "component", key
        case ("status" | "c3d" | "recording" as kind,):
            return kind, ""
        case ("schema", name) if name.removeprefix("rtc3d.") in MESSAGE_TYPES_BY_NAME:
            return "schema", name.removeprefix("rtc3d.")
        case ("schema", *_):
            raise QueryError(f"unknown type; accepted: {', '.join(MESSAGE_TYPES_BY_NAME)}")
    keys = ", ".join("/".join(key) for key in known_keys(components) if key[0] != "schema")
    raise QueryError(f"nothing is known of {'/'.join(parts)!r}; accepted: {keys}, schema/TYPE")


def schema_answer(name: str) -> Answer:
    """Return the ``.lcm`` text of a message type, as lcm-gen takes it."""
    return Answer((files("rtc3d") / f"{name}.lcm").read_bytes(), TEXT)


def message_answer(message: bytes, question: Question, attachment: Mapping[str, Any]) -> Answer:
    """Return one of our messages as it is, or as JSON with NaN as null."""
    decoded = decode(message)
    if question.as_json:
        return Answer(json_bytes(to_json(decoded)), JSON, attachment)
    return Answer(message, f"{LCM};rtc3d.{type(decoded).__name__}", attachment)


def parameters_json(parameters: Parameters, section: str) -> bytes:
    """Return the typed parameters as JSON: a section's object, or an object of all sections."""
    sections = {
        "general": parameters.general,
        "3d": parameters.markers,
        "6d": parameters.tools,
        "analog": parameters.analog,
        "force": parameters.force,
        "events": parameters.events,
    }
    values = {name: asdict(value) for name, value in sections.items() if value is not None}
    return json_bytes(values.get(section) if section else values)


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as compact JSON in UTF-8; numbers that JSON lacks are refused."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
