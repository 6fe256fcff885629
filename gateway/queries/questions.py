"""Questions about a source, parsed from the keys and options of peers' queries. No I/O, no waiting."""

from collections.abc import Collection, Iterable, Mapping
from typing import Final, Literal, NamedTuple
from urllib.parse import unquote

import rtc3d

from gateway.errors import QueryError
from gateway.messages.history import WantedMessages
from gateway.messages.host_time import now_utime
from gateway.messages.take_names import check_name
from gateway.outputs.contract import KeyPath
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ComponentType
from gateway.rtc3d.parameters import SECTIONS
from gateway.runtime.safe_text import quoted

SCHEMA_TYPES: Final = tuple(name for name in vars(rtc3d) if name.endswith("_t"))
"""The message types, and the types they contain."""

RECORDING: Final[KeyPath] = ("recording",)
HISTORY: Final[KeyPath] = ("history",)

_ANY: Final = {"NAME", "OPTIONS", "NUMBER"}
"""Each stands for the values of an option that is any text."""

_OPTIONS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "parameters": {"format": ("xml", "json"), "fresh": ("true", "false"), "stale": ("ok",)},
    "component": {"format": ("lcm", "json")},
    "messages": {"from": ("NUMBER",), "last_s": ("NUMBER",), "since_utime": ("NUMBER",), "to": ("NUMBER",)},
    "history": {},
    "status": {"format": ("lcm", "json")},
    "c3d": {},
    "schema": {},
    "recording": {"set": ("start", "stop"), "name": ("NAME",), "options": ("OPTIONS",)},
}
"""The options of each kind of question, with the values that each accepts."""


_BEGIN_OPTIONS: Final = {"from", "last_s", "since_utime"}
_RANGE_OPTIONS: Final = {*_BEGIN_OPTIONS, "to"}
"""The options that select messages of the history."""

_MAX_DIGITS: Final = 19
"""Sequence numbers and times have 63 bits."""


class Question(NamedTuple):
    """A query for one key of one source. ``kind`` decides which of the other fields are used.

    ``name`` is the section ("" for all), the key of the messages, the type, or the name of a recording.
    ``set`` is start, stop, or "" if the query does not have it. ``options`` are for the server that starts a
    recording. ``wanted`` says which messages of the history.
    """

    kind: Literal["parameters", "component", "messages", "history", "status", "c3d", "schema", "recording"]
    name: str = ""
    as_json: bool = False
    fresh: bool = False
    stale_ok: bool = False
    set: str = ""
    options: str = ""
    wanted: WantedMessages | None = None


def known_keys(components: Collection[ComponentType]) -> list[KeyPath]:
    """Return every key that can be queried for a source with these components."""
    return [
        ("parameters",),
        *(("parameters", section) for section in SECTIONS),
        *((component.key,) for component in WIRE_ORDER if component in components),
        ("status",),
        HISTORY,
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
    options = _split_again(options)
    kind, name = _kind_and_name(path, options, components)
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
        wanted=_wanted(options) if kind == "messages" else None,
    )


def _split_again(options: Mapping[str, str]) -> Mapping[str, str]:
    """Return the options of a query for messages as if ``;`` were between them: many people write ``&``."""
    if _RANGE_OPTIONS.isdisjoint(options):
        return options
    texts = [text for name, value in options.items() for text in f"{name}={value}".split("&")]
    return {name: value for name, _, value in (text.partition("=") for text in texts)}


def _wanted(options: Mapping[str, str]) -> WantedMessages:
    """Return which messages are wanted. Raises QueryError."""
    if len(_BEGIN_OPTIONS & options.keys()) != 1:
        raise QueryError(f"messages of the history need one of {', '.join(sorted(_BEGIN_OPTIONS))}")
    first = since_utime = last_s = None
    if "from" in options:
        first = _whole_number("from", options)
    elif "since_utime" in options:
        since_utime = _whole_number("since_utime", options)
    else:
        try:
            last_s = float(options["last_s"])
            last_us = round(1e6 * last_s)
        except (ValueError, OverflowError):
            last_us = -1
        if last_us < 0:
            raise QueryError(
                f"last_s={quoted(options['last_s'])} is not accepted; accepted: a number of seconds"
            )
        since_utime = max(0, now_utime() - last_us)
    last = _whole_number("to", options) if "to" in options else None
    return WantedMessages(first, since_utime, last, last_s)


def _whole_number(name: str, options: Mapping[str, str]) -> int:
    text = options[name]
    if not (text.isascii() and text.isdigit() and len(text) < _MAX_DIGITS):
        raise QueryError(f"{name}={quoted(text)} is not accepted; accepted: a whole number, 0 or more")
    return int(text)


def parse_questions(
    paths: Iterable[KeyPath], options: Mapping[str, str], components: Collection[ComponentType]
) -> dict[KeyPath, Question]:
    """Return the questions of a selector that matches several of the ``known_keys``.

    Each key gets the options that it accepts. Raises QueryError for an option or value that none of them
    accepts, and as ``parse_question`` does.
    """
    options = _split_again(options)
    kinds = {path: _kind_and_name(path, options, components)[0] for path in paths}
    _check_options(options, dict.fromkeys(kinds.values()))
    accepted = {
        kind: {name: value for name, value in options.items() if _is_accepted(kind, name, value)}
        for kind in kinds.values()
    }
    return {path: parse_question(path, accepted[kind], components) for path, kind in kinds.items()}


def _is_accepted(kind: str, name: str, value: str) -> bool:
    values = _OPTIONS[kind].get(name, ())
    return value in values or not _ANY.isdisjoint(values)


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


def _kind_and_name(
    path: KeyPath, options: Mapping[str, str], components: Collection[ComponentType]
) -> tuple[str, str]:
    """Return the first two fields of the Question for a key; raises QueryError."""
    wants_messages = not _RANGE_OPTIONS.isdisjoint(options)
    found: tuple[str, str]
    match path:
        case ("6d", tool):
            found = "messages", f"6d/{unquote(tool)}"
        case ("status" | "clock" as key,) if wants_messages:
            found = "messages", key
        case ("parameters",):
            found = "parameters", ""
        case ("parameters", section):
            check_sections([section])
            found = "parameters", section
        case (key,) if key in COMPONENTS_BY_KEY:
            if COMPONENTS_BY_KEY[key] not in components:
                configured = ", ".join(component.key for component in WIRE_ORDER if component in components)
                raise QueryError(
                    f"component {key!r} is not configured for this source; accepted: {configured}"
                )
            found = "messages" if wants_messages else "component", key
        case ("status" | "history" | "c3d" | "recording" as kind,):
            found = kind, ""
        case ("schema", name) if name.removeprefix("rtc3d.") in SCHEMA_TYPES:
            found = "schema", name.removeprefix("rtc3d.")
        case ("schema", *_):
            raise QueryError(f"unknown type; accepted: {', '.join(SCHEMA_TYPES)}")
        case _:
            raise QueryError(f"unknown key {quoted('/'.join(path))}; accepted: {accepted_keys(components)}")
    return found


def check_sections(sections: Iterable[str]) -> None:
    """Raise QueryError if one of ``sections`` does not exist (§6)."""
    if unknown := set(sections) - set(SECTIONS):
        raise QueryError(f"unknown section {quoted(min(unknown))}; accepted: {', '.join(SECTIONS)}")
