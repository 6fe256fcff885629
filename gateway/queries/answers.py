"""What can be asked about a source, and the forms of answers: no I/O, no waiting."""

import json
from collections.abc import Collection, Iterable, Mapping
from importlib.resources import files
from typing import Any, Final, Literal, NamedTuple

import rtc3d

from gateway.errors import QueryError
from gateway.messages.decode import decode, message_type, to_json
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import SECTIONS, Parameters

XML: Final = "application/xml"
JSON: Final = "application/json"
C3D: Final = "application/octet-stream"
TEXT: Final = "text/plain"
LCM: Final = "application/x-lcm"

Parts = tuple[str, ...]
"""A key below PREFIX/SOURCE/, cut at the slashes: ("parameters", "3d")."""

SCHEMA_TYPES: Final = tuple(name for name in vars(rtc3d) if name.endswith("_t"))
"""The message types, and the types that they consist of."""

_OPTIONS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "parameters": {"format": ("xml", "json"), "fresh": ("true", "false"), "stale": ("ok",)},
    "component": {"format": ("lcm", "json")},
    "status": {"format": ("lcm", "json")},
    "c3d": {},
    "schema": {},
    "recording": {"set": ("start", "stop")},
}
"""The options that each kind of key takes, with the values that each accepts."""


_SHOWN: Final = 60


class Question(NamedTuple):
    """One question about one source. ``kind`` says which of the other fields mean something.

    ``name`` is the section ("" for all), the component's key, or the type; ``set`` is start, stop, or
    "" where the asker did not say.
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
        *(("schema", name) for name in SCHEMA_TYPES),
    ]


def accepted_keys(components: Collection[ComponentType]) -> str:
    """Return ``known_keys`` for an error's text, the schemas as one."""
    keys = ["/".join(parts) for parts in known_keys(components) if parts[0] != "schema"]
    return ", ".join([*keys, "schema/TYPE"])


def parse_question(
    parts: Parts, options: Mapping[str, str], components: Collection[ComponentType]
) -> Question:
    """Return the question that a key and its selector's options ask.

    Raises QueryError, listing what is accepted, for an unknown key, section, component that is not
    configured, option or value.
    """
    kind, name = _kind_and_name(parts, components)
    _check_options(options, [kind])
    return Question(
        kind,  # type: ignore[arg-type]  # one of _OPTIONS' keys, which are those of Question.kind
        name,
        as_json=options.get("format") == "json",
        fresh=options.get("fresh") == "true",
        stale_ok="stale" in options,
        set=options.get("set", ""),
    )


def parse_questions(
    keys: Iterable[Parts], options: Mapping[str, str], components: Collection[ComponentType]
) -> dict[Parts, Question]:
    """Return the questions of a selector that asks of several ``known_keys``.

    Each key takes the options that mean something to it. Raises QueryError for an option or value that
    means nothing to any of them.
    """
    kinds = {parts: _kind_and_name(parts, components)[0] for parts in keys}
    _check_options(options, dict.fromkeys(kinds.values()))
    fitting = {
        kind: {name: value for name, value in options.items() if value in _OPTIONS[kind].get(name, ())}
        for kind in kinds.values()
    }
    return {parts: parse_question(parts, fitting[kind], components) for parts, kind in kinds.items()}


def _check_options(options: Mapping[str, str], kinds: Iterable[str]) -> None:
    """Raise QueryError unless each option is accepted, with its value, by one of the kinds of keys."""
    accepted: dict[str, dict[str, None]] = {}
    for kind in kinds:
        for name, values in _OPTIONS[kind].items():
            accepted.setdefault(name, {}).update(dict.fromkeys(values))
    for name, value in options.items():
        if name not in accepted:
            known = ", ".join(f"{each}={'|'.join(values)}" for each, values in accepted.items())
            raise QueryError(
                f"unknown option {_shown(name)} of {', '.join(kinds)}; accepted: {known or 'none'}"
            )
        if value not in accepted[name]:
            raise QueryError(f"{name}={_shown(value)} is not accepted; accepted: {', '.join(accepted[name])}")


def _kind_and_name(parts: Parts, components: Collection[ComponentType]) -> tuple[str, str]:
    match parts:
        case ("parameters",):
            return "parameters", ""
        case ("parameters", section) if section in SECTIONS:
            return "parameters", section
        case ("parameters", section):
            raise QueryError(unknown_section(section))
        case (key,) if key in COMPONENTS_BY_KEY:
            if COMPONENTS_BY_KEY[key] not in components:
                configured = ", ".join(component.key for component in WIRE_ORDER if component in components)
                raise QueryError(
                    f"component {key!r} is not configured for this source; accepted: {configured}"
                )
            return "component", key
        case ("status" | "c3d" | "recording" as kind,):
            return kind, ""
        case ("schema", name) if name.removeprefix("rtc3d.") in SCHEMA_TYPES:
            return "schema", name.removeprefix("rtc3d.")
        case ("schema", *_):
            raise QueryError(f"unknown type; accepted: {', '.join(SCHEMA_TYPES)}")
    raise QueryError(f"nothing is known of {_shown('/'.join(parts))}; accepted: {accepted_keys(components)}")


def unknown_section(section: str) -> str:
    """Return the text of the error for a section of parameters that does not exist."""
    return f"unknown section {_shown(section)}; accepted: {', '.join(SECTIONS)}"


def schema_answer(name: str) -> Answer:
    """Return the ``.lcm`` text of a type, as lcm-gen takes it; the types that it consists of come first."""
    texts = [(files("rtc3d") / f"{each}.lcm").read_text(encoding="utf-8") for each in _with_parts(name)]
    return Answer("\n".join(texts).encode(), TEXT)


def _with_parts(name: str) -> list[str]:
    """Return the type's name behind those of the types that it consists of, each once."""
    names: dict[str, None] = {}
    for type_name in getattr(rtc3d, name).__typenames__:
        package, _, part = type_name.rpartition(".")
        if package:
            names |= dict.fromkeys(_with_parts(part))
    return [*names, name]


def message_answer(message: bytes, question: Question, attachment: Mapping[str, Any]) -> Answer:
    """Return one of our messages as it is, or as JSON with NaN as null."""
    if question.as_json:
        return Answer(json_bytes(to_json(decode(message))), JSON, attachment)
    return Answer(message, f"{LCM};rtc3d.{message_type(message).__name__}", attachment)


def parameters_json(parameters: Parameters, section: str) -> bytes | None:
    """Return the typed parameters as JSON, NaN as null: an object of all sections, or one section's.

    None if ``section`` is not among them.
    """
    values = {key: section.of(parameters) for key, section in SECTIONS.items()}
    if section:
        return None if values[section] is None else json_bytes(to_json(values[section]))
    return json_bytes({name: to_json(value) for name, value in values.items() if value is not None})


def json_bytes(value: Any) -> bytes:
    """Return ``value`` as compact JSON in UTF-8; numbers that JSON lacks are refused."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def _shown(text: str) -> str:
    """Return a word of an asker's fit for an error's text: bounded, printable."""
    return ascii(text if len(text) <= _SHOWN else text[:_SHOWN] + "…")
