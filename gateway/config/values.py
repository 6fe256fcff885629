"""The types of values in the configuration: what they accept, and how YAML represents them.

At the end, those of the section ``transform`` of a source, and the section itself.
"""

import ipaddress
import math
import re
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    model_validator,
)

from gateway.config.section import Section, expects, validation_error
from gateway.config.words import describe, join_or, spelling_hint
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ByteOrder, ComponentType

_COMPONENT_KEYS: Final = [component.key for component in WIRE_ORDER]


def _host(text: str) -> str:
    """Return ``text`` if it is an IP address, or a name that can be sent to a name server (RFC 1035, IDNA).

    A name whose last label is a number would be an address to the resolver, for example 127.1 or 0x7f.1.
    Such short forms are refused, because they are usually mistakes. An IPv6 address may have a scope, the
    name or number of a network interface: fe80::1%eth0.
    """
    if "%" in text:
        ipaddress.IPv6Address(text)
        scope = text.partition("%")[2]
        if not re.fullmatch(
            r"[!-$&-.0-~]{1,15}", scope
        ):  # what Linux accepts: 15 bytes, without / and spaces
            raise ValueError
        return text
    if re.fullmatch(r"[\w-]+(\.[\w-]+)*\.?", text):
        encoded = text.encode("idna").decode()  # UnicodeError, a ValueError: a label is empty or too long
        last_label = encoded.rstrip(".").rpartition(".")[2]
        if len(encoded) <= 253 and not re.fullmatch("[0-9]+|0[xX][0-9a-fA-F]*", last_label):
            return text
    ipaddress.ip_address(text)  # raises ValueError
    return text


def _check(is_valid: Callable[[Any], bool]) -> AfterValidator:
    """Return an annotation that refuses values for which ``is_valid`` is false."""

    def check(value: object) -> object:
        if not is_valid(value):
            raise ValueError
        return value

    return AfterValidator(check)


not_empty: Final = _check(bool)
"""Refuses an empty list. With a minimum length on the type, pydantic would count only the valid items."""

_NUMBER: Final = partial(Field, strict=True, allow_inf_nan=False)

ChannelPrefix = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_]{1,16}$"),
    expects("1 to 16 of the letters A to Z and a to z, digits and '_'"),
]
Switch = Annotated[bool, Field(strict=True), expects("true or false")]
Seconds = Annotated[float, _NUMBER(ge=0.001, le=86400), expects("a number of seconds from 0.001 to 86400")]
IntervalSeconds = Annotated[
    float,
    _NUMBER(ge=0, le=86400),
    _check(lambda seconds: not 0 < seconds < 0.1),
    expects("0 for never, or a number of seconds from 0.1 to 86400"),
]
Milliseconds = Annotated[float, _NUMBER(ge=1, le=60_000), expects("a number of milliseconds from 1 to 60000")]
Hertz = Annotated[
    float, _NUMBER(gt=0, le=1_000_000), expects("a number of frames per second above 0, up to 1000000")
]
QueryRate = Annotated[
    float, _NUMBER(ge=1, le=1_000_000), expects("a number of queries per second from 1 to 1000000")
]
Speed = Annotated[float, _NUMBER(ge=1.5, le=1000), expects("a number from 1.5 to 1000")]
Divisor = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]
ByteLimit = Annotated[
    int,
    Field(strict=True, ge=1024, le=0xFFFFFFFF),  # a packet's size field has 32 bits (§4.1)
    expects("a whole number of bytes from 1024 to 4294967295"),
]
FileLimit = Annotated[
    int, Field(strict=True, ge=1, le=100_000), expects("a whole number of files from 1 to 100000")
]
AbsoluteDirectory = Annotated[
    str,
    _check(lambda text: text.startswith("/") and text.isprintable()),
    expects("a folder's absolute path, or null"),
]
Host = Annotated[
    str, AfterValidator(_host), expects("a host name or an IP address; the port has its own key")
]
Port = Annotated[int, Field(strict=True, ge=1, le=65535), expects("a whole number from 1 to 65535")]
# The length limit lets the channel PREFIX_NAME_PARAMETERS_REQUEST fit into LCM's 63 characters.
SourceName = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_-]{1,24}$"),
    expects("1 to 24 of the letters A to Z and a to z, digits, '_' and '-'"),
]


FrameId = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_./-]{0,63}$"),
    expects("1 to 64 of the letters A to Z and a to z, digits, '_', '.', '-' and, except first, '/'"),
]


class FrequencyRate(Section):
    """``rate: {frequency_hz: 60}``."""

    frequency_hz: Hertz
    """The average number of frames per second."""


class DivisorRate(Section):
    """``rate: {divisor: 4}``."""

    divisor: Divisor
    """With N, the server sends every Nth frame."""


def _rate(value: object) -> Rate:
    match value:
        case AllFrames() | Frequency() | FrequencyDivisor():
            return value
        case "all":
            return AllFrames()
        case {"frequency_hz": _, "divisor": _}:
            raise validation_error("found frequency_hz and divisor together; expected one of them")
        case {"frequency_hz": _}:
            return Frequency(FrequencyRate.model_validate(value).frequency_hz)
        case {"divisor": _}:
            return FrequencyDivisor(DivisorRate.model_validate(value).divisor)
    raise validation_error(f"found {describe(value)}; expected all, {{frequency_hz: 60}} or {{divisor: 4}}")


def _rate_to_yaml(rate: Rate) -> str | dict[str, float] | dict[str, int]:
    match rate:
        case Frequency(hz):
            return {"frequency_hz": hz}
        case FrequencyDivisor(divisor):
            return {"divisor": divisor}
    return "all"


def _components(value: object) -> tuple[ComponentType, ...]:
    if not isinstance(value, list | tuple) or not value:
        raise validation_error(
            f"found {describe(value)}; expected a list of {join_or(_COMPONENT_KEYS)}, or [all]"
        )
    if list(value) == ["all"]:
        return WIRE_ORDER
    components: list[ComponentType] = []
    for index, item in enumerate(value):
        if item == "all":
            raise validation_error("found 'all' beside other components; expected [all] alone", index)
        component = _component(item, index)
        if component in components:
            raise validation_error(f"found {component.key!r} twice; expected each component once", index)
        components.append(component)
    return tuple(component for component in WIRE_ORDER if component in components)


def _component(item: object, *location: int) -> ComponentType:
    if isinstance(item, ComponentType):
        return item
    if isinstance(item, str) and item in COMPONENTS_BY_KEY:
        return COMPONENTS_BY_KEY[item]
    hint = spelling_hint(item, _COMPONENT_KEYS)
    raise validation_error(f"found {describe(item)}{hint}; expected {join_or(_COMPONENT_KEYS)}", *location)


Components = Annotated[
    tuple[ComponentType, ...],
    PlainValidator(
        _components, json_schema_input_type=list[Literal["3d", "6d", "analog", "force", "event", "all"]]
    ),
    PlainSerializer(lambda components: [component.key for component in components]),
]
"""In YAML: [all], or a list of keys. Kept in WIRE_ORDER."""

StreamRate = Annotated[
    Rate,
    PlainValidator(_rate, json_schema_input_type=Literal["all"] | FrequencyRate | DivisorRate),
    PlainSerializer(_rate_to_yaml),
]
"""In YAML: all, {frequency_hz: NUMBER} or {divisor: WHOLE NUMBER}."""

Backlog = Annotated[Literal["latest", "all"], expects("latest or all")]

ServerByteOrder = Annotated[ByteOrder, expects("big or little")]

_RATES: Final = TypeAdapter(dict[str, Hertz])


def _max_rates(value: object) -> dict[ComponentType, float]:
    if not isinstance(value, dict):
        raise validation_error(f"found {describe(value)}; expected a mapping such as {{3d: 60}}, or {{}}")
    rates = {}
    for key, rate in value.items():
        component = _component(key)
        rates[component] = _RATES.validate_python({component.key: rate})[component.key]
    return rates


MaxRates = Annotated[
    dict[ComponentType, float],
    PlainValidator(_max_rates, json_schema_input_type=dict[Literal["3d", "6d", "analog", "force"], Hertz]),
    PlainSerializer(lambda rates: {component.key: rate for component, rate in rates.items()}),
]
"""In YAML: {3d: NUMBER, …}, in Hz."""

_MAX_NORM_ERROR: Final = 0.01  # quaternions are often written with two or three digits

_Number = Annotated[float, _NUMBER(ge=-1e6, le=1e6), expects("a number from -1000000 to 1000000")]


def _has_items(count: int) -> BeforeValidator:
    """Return an annotation that refuses lists of another length as a whole."""

    def check(value: object) -> object:
        if isinstance(value, list | tuple) and len(value) != count:
            raise ValueError
        return value

    return BeforeValidator(check)


def _unit_quaternion(values: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.hypot(*values)
    if not norm:
        raise validation_error("found only zeros, which is no rotation; expected [0, 0, 0, 1] for none")
    x, y, z, w = (value / norm for value in values)
    if abs(norm - 1) > _MAX_NORM_ERROR:
        found, expected = ([f"{number:.4g}" for number in numbers] for numbers in (values, (x, y, z, w)))
        raise validation_error(
            f"found [{', '.join(found)}], whose squares do not add up to 1; "
            f"expected x y z w, such as [{', '.join(expected)}]"
        )
    return (x, y, z, w)


Degrees = Annotated[float, _NUMBER(ge=-360, le=360), expects("a number of degrees from -360 to 360")]
Unit = Annotated[
    Literal["m", "dm", "cm", "mm", "um", "in", "ft"],
    expects("m, dm, cm, mm, um, in or ft, or null for the server's"),
]
Scale = Annotated[float, _NUMBER(ge=1e-6, le=1e6), expects("a number from 0.000001 to 1000000")]
UpAxis = Annotated[Literal["y", "z"], expects("y or z")]
QuaternionXyzw = Annotated[
    tuple[_Number, _Number, _Number, _Number],
    _has_items(4),
    expects("a list of four numbers, x y z w, such as [0, 0, 0, 1]"),
    AfterValidator(_unit_quaternion),
]
Metres3 = Annotated[
    tuple[_Number, _Number, _Number],
    _has_items(3),
    expects("a list of three numbers of metres, x y z, such as [2.5, 0, 0]"),
]


class RollPitchYaw(Section):
    """A rotation as angles about the fixed axes: first roll about x, then pitch about y, then yaw about z."""

    roll: Degrees = 0.0
    """The angle about x, in degrees."""

    pitch: Degrees = 0.0
    """The angle about y, in degrees."""

    yaw: Degrees = 0.0
    """The angle about z, in degrees."""


def check_one_rotation(rotation_xyzw: tuple[float, ...] | None, rotation_deg: RollPitchYaw) -> None:
    """Raise the error of a section that has both forms of a rotation."""
    if rotation_xyzw is not None and rotation_deg != RollPitchYaw():
        raise validation_error("found rotation_xyzw, too; expected one of the two", "rotation_deg")


class TransformSettings(Section):
    """From the server's units and axes to the frame of poses: units, scale, up, rotation, translation.

    They are applied in this order.
    """

    units: Unit | None = None
    """The server's unit of length, if its parameters give a wrong one or none. null means as they say."""

    scale: Scale = 1.0
    """A factor for all positions."""

    up: UpAxis = "z"
    """The axis of the server that points up. With y, the axes are turned so that z points up."""

    rotation_xyzw: QuaternionXyzw | None = None
    """The rotation after `up`, as a quaternion."""

    rotation_deg: RollPitchYaw = RollPitchYaw()
    """The rotation after `up`, as angles. Only one of the two can be given."""

    translation_m: Metres3 = (0.0, 0.0, 0.0)
    """Where the server's origin is in the frame of the lab, in metres."""

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        check_one_rotation(self.rotation_xyzw, self.rotation_deg)
        return self
