"""The test vectors in lcm_types/vectors/: bytes of messages, and the values that they decode to."""

import json
import math
import struct
from pathlib import Path
from typing import Any, Final, NamedTuple

import rtc3d

FOLDER: Final = Path(__file__).parents[1] / "lcm_types/vectors"
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
