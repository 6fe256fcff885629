"""What breaks a promise: values, JSON and schemas of an earlier version beside those of this one."""

from collections.abc import Iterator
from typing import Any

from jsonschema import Draft202012Validator


def broken(old: Any, new: Any, place: str = "") -> Iterator[str]:
    """Yield what is missing in ``new``, or different, of all that ``old`` has."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key, value in old.items():
            here = f"{place} → {key}" if place else str(key)
            if key in new:
                yield from broken(value, new[key], here)
            else:
                yield f"{here}: is gone"
    elif isinstance(old, list) and isinstance(new, list):
        if any(isinstance(item, dict) for item in old):
            yield from broken(dict(enumerate(old)), dict(enumerate(new)), place)
        else:
            yield from (f"{place}: {item!r} is gone" for item in old if item not in new)
    elif old != new:
        yield f"{place}: was {old!r}, is {new!r}"


def kinds(value: Any) -> dict[str, list[str]]:
    """Return which kinds of values there are in JSON at each place, such as $.sources[].name: text.

    Programs rely on these, and not on the values, which differ from run to run.
    """
    found: dict[str, set[str]] = {}
    for place, kind in _kinds(value, "$"):
        found.setdefault(place, set()).add(kind)
    return {place: sorted(each) for place, each in found.items()}


def _kinds(value: Any, place: str) -> Iterator[tuple[str, str]]:
    match value:
        case dict():
            yield place, "object"
            for key, item in value.items():
                yield from _kinds(item, f"{place}.{key}")
        case list():
            yield place, "list"
            for item in value:
                yield from _kinds(item, f"{place}[]")
        case bool():
            yield place, "true or false"
        case int() | float():
            yield place, "number"
        case str():
            yield place, "text"
        case None:
            yield place, "null"


def broken_kinds(old: Any, new: Any) -> Iterator[str]:
    """Yield what a program that reads the JSON ``old`` does not find in ``new``, or finds of another kind.

    Where ``old`` has null, such as for what is not known in the first seconds, any value will do.
    """
    now = kinds(new)
    for place, expected in kinds(old).items():
        if place not in now:
            yield f"{place}: is gone"
        elif "null" not in expected and not set(now[place]) <= set(expected):
            yield f"{place}: was {' or '.join(expected)}, is {' or '.join(now[place])}"


def broken_schema(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    """Yield which keys of the JSON schema ``old`` are gone, accept less, or have another default."""
    now = keys_of(new)
    for place, schema in keys_of(old).items():
        if place not in now:
            yield f"{place}: is gone"
            continue
        validator = Draft202012Validator(now[place])
        yield from (
            f"{place}: {each!r} is refused" for each in _samples(schema) if not validator.is_valid(each)
        )
        for keyword in {"default", "pattern"} & schema.keys():
            yield from broken(schema[keyword], now[place].get(keyword), f"{place}: {keyword}")


def keys_of(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the schema of each key, such as sources[].name, without references to other parts."""
    return dict(_keys(schema, schema, ""))


def _keys(schema: dict[str, Any], root: dict[str, Any], place: str) -> Iterator[tuple[str, dict[str, Any]]]:
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
    for alternative in schema.get("anyOf", ()):
        yield from _keys(alternative, root, place)
    if "items" in schema:
        yield from _keys(schema["items"], root, f"{place}[]")
    for name, inner in schema.get("properties", {}).items():
        here = f"{place}.{name}".removeprefix(".")
        yield here, {**inner, "$defs": root["$defs"]}
        yield from _keys(inner, root, here)


def _samples(schema: dict[str, Any]) -> Iterator[Any]:
    """Yield values that a schema accepts, above all those at its limits."""
    yield from (schema[key] for key in ("default", "const", "minimum", "maximum") if key in schema)
    yield from schema.get("enum", ())
    yield from {"boolean": (True, False), "null": (None,)}.get(schema.get("type", ""), ())
    for alternative in schema.get("anyOf", ()):
        yield from _samples(alternative)
