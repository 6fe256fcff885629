"""Questions about a source, parsed from the keys and options of peers' queries. No I/O, no waiting."""

from collections.abc import Collection, Iterable, Mapping
from typing import Final, Literal, NamedTuple

import rtc3d

from gateway.errors import QueryError
from gateway.logs.safe_text import quoted
from gateway.outputs.contract import KeyPath
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import SECTIONS
from gateway.takes.files.new_file import check_name

SCHEMA_TYPES: Final = tuple(name for name in vars(rtc3d) if name.endswith("_t"))
"""The message types, and the types they contain."""

RECORDING: Final[KeyPath] = ("recording",)

_ANY: Final = {"NAME", "OPTIONS"}
"""Each stands for the values of an option that is any text."""

_OPTIONS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "parameters": {"format": ("xml", "json"), "fresh": ("true", "false"), "stale": ("ok",)},
    "component": {"format": ("lcm", "json")},
    "status": {"format": ("lcm", "json")},
    "c3d": {},
    "schema": {},
    "recording": {"set": ("start", "stop"), "name": ("NAME",), "options": ("OPTIONS",)},
}
"""The options of each kind of question, with the values that each accepts."""


class Question(NamedTuple):
    """A query for one key of one source. ``kind`` decides which of the other fields are used.

    ``name`` is the section ("" for all), the component's key, the type, or the name of a recording. ``set``
    is start, stop, or "" if the query does not have it. ``options`` are for the server that starts a
    recording.
    """

    kind: Literal["parameters", "component", "status", "c3d", "schema", "recording"]
    name: str = ""
    as_json: bool = False
    fresh: bool = False
    stale_ok: bool = False
    set: str = ""
    options: str = ""


def known_keys(components: Collection[ComponentType]) -> list[KeyPath]:
    """Return every key that can be queried for a source with these components."""
    return [
        ("parameters",),
        *(("parameters", section) for section in SECTIONS),
        *((component.key,) for component in WIRE_ORDER if component in components),
        ("status",),
        ("c3d",),
        RECORDING,
        *(("schema", name) for name in SCHEMA_TYPES),
    ]


def accepted_keys(components: Collection[ComponentType], commands: Iterable[str] = ()) -> str:
    """Return the keys that can be queried, and the outputs' ``commands``, as text for an error message."""
    keys = ["/".join(path) for path in known_keys(components) if path[0] != "schema"]
    return ", ".join([*keys, "schema/TYPE", *commands])


def parse_question(
    path: KeyPath, options: Mapping[str, str], components: Collection[ComponentType]
) -> Question:
    """Return the question that a key and the options of its selector stand for.

    Raises QueryError, with what is accepted, for an unknown key, section, option or value, and for a
    component that is not configured.
    """
    kind, name = _kind_and_name(path, components)
    _check_options(options, [kind])
    for option in ("name", "options"):
        if option in options and options.get("set") != "start":
            raise QueryError(f"{option} is an option of set=start only")
    if "name" in options:
        name = options["name"]
        check_name(name)
    return Question(
        kind,  # type: ignore[arg-type]  # _OPTIONS and Question.kind have the same kinds
        name,
        as_json=options.get("format") == "json",
        fresh=options.get("fresh") == "true",
        stale_ok="stale" in options,
        set=options.get("set", ""),
        options=options.get("options", ""),
    )


def parse_questions(
    paths: Iterable[KeyPath], options: Mapping[str, str], components: Collection[ComponentType]
) -> dict[KeyPath, Question]:
    """Return the questions of a selector that matches several of the ``known_keys``.

    Each key gets the options that it accepts. Raises QueryError for an option or value that none of them
    accepts, and as ``parse_question`` does.
    """
    kinds = {path: _kind_and_name(path, components)[0] for path in paths}
    _check_options(options, dict.fromkeys(kinds.values()))
    accepted = {
        kind: {name: value for name, value in options.items() if value in _OPTIONS[kind].get(name, ())}
        for kind in kinds.values()
    }
    return {path: parse_question(path, accepted[kind], components) for path, kind in kinds.items()}


def _check_options(options: Mapping[str, str], kinds: Iterable[str]) -> None:
    """Raise QueryError unless at least one of the kinds accepts each option and its value."""
    accepted: dict[str, dict[str, None]] = {}
    for kind in kinds:
        for name, values in _OPTIONS[kind].items():
            accepted.setdefault(name, {}).update(dict.fromkeys(values))
    for name, value in options.items():
        if name not in accepted:
            known = ", ".join(f"{option}={'|'.join(values)}" for option, values in accepted.items())
            raise QueryError(
                f"unknown option {quoted(name)} of {', '.join(kinds)}; accepted: {known or 'none'}"
            )
        if _ANY.isdisjoint(accepted[name]) and value not in accepted[name]:
            raise QueryError(f"{name}={quoted(value)} is not accepted; accepted: {', '.join(accepted[name])}")


def _kind_and_name(path: KeyPath, components: Collection[ComponentType]) -> tuple[str, str]:
    """Return the first two fields of the Question for a key; raises QueryError."""
    match path:
        case ("parameters",):
            return "parameters", ""
        case ("parameters", section):
            check_sections([section])
            return "parameters", section
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
    raise QueryError(f"unknown key {quoted('/'.join(path))}; accepted: {accepted_keys(components)}")


def check_sections(sections: Iterable[str]) -> None:
    """Raise QueryError if one of ``sections`` does not exist (§6)."""
    if unknown := set(sections) - set(SECTIONS):
        raise QueryError(f"unknown section {quoted(min(unknown))}; accepted: {', '.join(SECTIONS)}")
