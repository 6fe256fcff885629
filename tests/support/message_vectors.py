"""The test vectors in lcm_types/vectors/: bytes of messages, and the values that they decode to.

``random_message`` makes further messages.
"""

import json
import math
import random
import struct
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

FOLDER: Final = Path(__file__).parents[2] / "lcm_types/vectors"
_NOT_FINITE: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
_INTEGERS: Final = {"int8_t", "int16_t", "int32_t", "int64_t"}


class MessageVector(NamedTuple):
    """A message, ``data``, and its values by field.

    Floats that JSON cannot hold are the texts "nan", "inf" and "-inf".
    """

    type_name: str
    name: str
    data: bytes
    values: dict[str, Any]
    fields: list[tuple[bytes, str]]
    """The parts of ``data``, in order, and what each is."""

    @property
    def lcm_type(self) -> Any:
        return getattr(rtc3d, self.type_name)

    def __str__(self) -> str:
        return f"{self.type_name}, {self.name}"


def _read(path: Path) -> list[MessageVector]:
    content = json.loads(path.read_text())
    assert content["type"] == f"rtc3d.{path.stem}"
    return [
        MessageVector(
            path.stem,
            vector["name"],
            bytes.fromhex(vector["hex"]),
            vector["values"],
            [(bytes.fromhex(digits), meaning) for digits, meaning in vector["bytes"]],
        )
        for vector in content["vectors"]
    ]


VECTORS: Final = [vector for path in sorted(FOLDER.glob("*.json")) for vector in _read(path)]


def to_vector_values(value: Any) -> Any:
    """Return an LCM object as in the vectors: numbers that JSON cannot hold are texts."""
    if hasattr(value, "__slots__"):
        return {name: to_vector_values(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, list | tuple):
        return [to_vector_values(item) for item in value]
    return str(value) if isinstance(value, float) and value - value != 0 else value


def difference(lcm_type: Any, expected: dict[str, Any], found: Any, where: str = "") -> str | None:
    """Return where ``found``, read from JSON, differs from the values of an LCM type; None if it does not.

    Floats are equal if their 32 or 64 bits are, except that a NaN has any bits and 0 any sign.
    """
    if not isinstance(found, dict) or sorted(found) != sorted(lcm_type.__slots__):
        return f"{where or lcm_type.__name__} has the fields {found!r}"
    for field, type_name, dimensions in zip(
        lcm_type.__slots__, lcm_type.__typenames__, lcm_type.__dimensions__, strict=True
    ):
        here = f"{where}.{field}" if where else field
        if problem := _difference(type_name, dimensions is not None, expected[field], found[field], here):
            return problem
    return None


def _difference(type_name: str, is_array: bool, expected: Any, found: Any, where: str) -> str | None:
    if is_array:
        if not isinstance(found, list) or len(found) != len(expected):
            return f"{where} is {found!r}, not {expected!r}"
        problems = (
            _difference(type_name, False, item, other, f"{where}[{index}]")
            for index, (item, other) in enumerate(zip(expected, found, strict=True))
        )
        return next(filter(None, problems), None)
    if type_name.startswith("rtc3d."):
        return difference(getattr(rtc3d, type_name.removeprefix("rtc3d.")), expected, found, where)
    return None if _same(type_name, expected, found) else f"{where} is {found!r}, not {expected!r}"


def _same(type_name: str, expected: Any, found: Any) -> bool:
    if type_name in {"float", "double"}:
        letter = "f" if type_name == "float" else "d"
        return _rounded(expected, letter) == _rounded(found, letter)
    kind = int if type_name in _INTEGERS else bool if type_name == "boolean" else str
    return type(found) is kind and found == expected


def _rounded(value: Any, letter: str) -> float | str | None:
    """Return a number as the nearest float of this size, and "nan" for a NaN; None if it is not a number."""
    if isinstance(value, str):
        value = _NOT_FINITE.get(value)
    if value is None or isinstance(value, bool):
        return None
    try:
        [number] = struct.unpack(letter, struct.pack(letter, value))
    except (OverflowError, struct.error):
        return None
    return "nan" if math.isnan(number) else float(number)


def random_message(lcm_type: Any, generator: random.Random) -> Any:
    """Return a message with random values, among them the largest and smallest ones and odd texts."""
    message = lcm_type()
    for field, type_name, dimensions in zip(
        lcm_type.__slots__, lcm_type.__typenames__, lcm_type.__dimensions__, strict=True
    ):
        if dimensions is None:
            value = _random_value(type_name, generator)
        else:
            [size] = dimensions
            if isinstance(size, str):  # the field with the number of items
                num_items = generator.choice((0, 1, 2, 7))
                setattr(message, size, num_items)
                size = num_items
            value = [_random_value(type_name, generator) for _ in range(size)]
        setattr(message, field, value)
    return message


def _random_value(type_name: str, generator: random.Random) -> Any:
    match type_name:
        case "int32_t" | "int64_t":
            limit = 1 << (31 if type_name == "int32_t" else 63)
            return generator.choice((0, -1, limit - 1, -limit, generator.randrange(-limit, limit)))
        case "float" | "double":
            letter, size = ("f", 4) if type_name == "float" else ("d", 8)
            [anything] = struct.unpack(letter, generator.randbytes(size))
            [smallest] = struct.unpack(f"<{letter}", (1).to_bytes(size, "little"))
            [position] = struct.unpack(letter, struct.pack(letter, generator.uniform(-5000, 5000)))
            return generator.choice((0.0, math.nan, math.inf, -math.inf, anything, smallest, position))
        case "boolean":
            return generator.choice((True, False))
        case "string":
            letters = "aZ0 /\\\"'{}\t\n\r\x01\x1f\x7f\x80äß€\u2028\ufeff\ufffd😀\U0010ffff"
            return "".join(generator.choices(letters, k=generator.choice((0, 1, 5, 40))))
    return random_message(getattr(rtc3d, type_name.removeprefix("rtc3d.")), generator)
