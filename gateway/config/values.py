"""The types of the configuration's single values: what is accepted, and how YAML writes it."""

import ipaddress
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import zenoh
from pydantic import AfterValidator, Field, PlainSerializer, PlainValidator, TypeAdapter, ValidationInfo

from gateway.config.secrets import mask_secrets_in_text
from gateway.config.section import Section, describe, expects, join_or, spelling_hint, validation_error
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import COMPONENTS_BY_KEY, WIRE_ORDER, ByteOrder, ComponentType

LCM_PROVIDERS: Final = ("udpm", "mpudpm", "memq", "tcpq", "file")
"""The URL schemes that the lcm package knows."""

_ZENOH_MESSAGE: Final = re.compile(
    r'Message \{ msg: "((?:[^"\\]|\\.)*)", location: Some\(Location \{ line: (\d+), column: (\d+)'
)
"""How Zenoh tells of a value in a file that it cannot use: a Rust debug text."""

_Item = TypeVar("_Item")
_COMPONENT_KEYS: Final = [component.key for component in WIRE_ORDER]


def _host(text: str) -> str:
    is_name = len(text) <= 253 and re.fullmatch(r"[\w-]{1,63}(\.[\w-]{1,63})*\.?", text)
    if not is_name or re.fullmatch("[0-9.]+", text):
        ipaddress.ip_address(text)  # raises ValueError
    return text


def not_empty(values: tuple[_Item, ...]) -> tuple[_Item, ...]:
    """Return ``values``; raise ValueError if there are none."""
    # As a limit on the type, pydantic would count the valid items alone.
    if not values:
        raise ValueError
    return values


def _key_prefix(text: str) -> str:
    if len(text) > 128 or not all(text.split("/")) or not text.isprintable() or re.search(r"[\s*$#?]", text):
        raise ValueError
    return text


def _lcm_url(text: str) -> str:
    provider, separator, rest = text.partition("://")
    if provider not in LCM_PROVIDERS or not separator or not text.isprintable() or " " in text:
        raise ValueError
    if "@" in rest.partition("/")[0]:  # LCM knows no password, and says the whole URL in the log
        raise ValueError
    return text


def _absolute_path(text: str) -> str:
    if not text.startswith("/") or not text.isprintable():
        raise ValueError
    return text


Switch = Annotated[bool, Field(strict=True), expects("true or false")]
Seconds = Annotated[
    float,
    Field(strict=True, ge=0.001, le=86400, allow_inf_nan=False),
    expects("a number of seconds from 0.001 to 86400"),
]
Milliseconds = Annotated[
    float,
    Field(strict=True, ge=1, le=60_000, allow_inf_nan=False),
    expects("a number of milliseconds from 1 to 60000"),
]
Hertz = Annotated[
    float,
    Field(strict=True, gt=0, le=1_000_000, allow_inf_nan=False),
    expects("a number of frames per second above 0, up to 1000000"),
]
Divisor = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]
ByteLimit = Annotated[
    int,
    Field(strict=True, ge=1024, le=0xFFFFFFFF),  # a packet's size field has 32 bits (§4.1)
    expects("a whole number of bytes from 1024 to 4294967295"),
]
FileLimit = Annotated[
    int, Field(strict=True, ge=1, le=100_000), expects("a whole number of files from 1 to 100000")
]
SpoolDirectory = Annotated[str, AfterValidator(_absolute_path), expects("a folder's absolute path, or null")]
Host = Annotated[
    str, AfterValidator(_host), expects("a host name or an IP address; the port has its own key")
]
Port = Annotated[int, Field(strict=True, ge=1, le=65535), expects("a whole number from 1 to 65535")]
# Their lengths are such that PREFIX_NAME_PARAMETERS_REQUEST fits LCM's 63 characters.
SourceName = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_-]{1,24}$"),
    expects("1 to 24 of the letters A to Z and a to z, digits, '_' and '-'"),
]
ChannelPrefix = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_]{1,16}$"),
    expects("1 to 16 of the letters A to Z and a to z, digits and '_'"),
]
KeyPrefix = Annotated[
    str,
    AfterValidator(_key_prefix),
    expects(
        "a Zenoh key of at most 128 characters, such as mocap or site/mocap, "
        "without spaces, * $ # ?, and without a leading, trailing or double /"
    ),
]
LcmUrl = Annotated[
    str,
    AfterValidator(_lcm_url),
    expects(
        f"a URL that begins with {join_or(f'{provider}://' for provider in LCM_PROVIDERS)}, "
        "without a user name"
    ),
]


class FrequencyRate(Section):
    """``rate: {frequency_hz: 60}``."""

    frequency_hz: Hertz
    """About so many frames per second."""


class DivisorRate(Section):
    """``rate: {divisor: 4}``."""

    divisor: Divisor
    """One frame of so many."""


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


def _rate_as_in_yaml(rate: Rate) -> str | dict[str, float] | dict[str, int]:
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
    components = [_component(item, index) for index, item in enumerate(value)]
    for index, component in enumerate(components):
        if component in components[:index]:
            raise validation_error(f"found {component.key!r} twice; expected each component once", index)
    return tuple(component for component in WIRE_ORDER if component in components)


def _component(item: object, index: int) -> ComponentType:
    match item:
        case ComponentType():
            return item
        case "all":
            raise validation_error("found 'all' beside other components; expected [all] alone", index)
        case str() if item in COMPONENTS_BY_KEY:
            return COMPONENTS_BY_KEY[item]
    meant = spelling_hint(item, _COMPONENT_KEYS)
    raise validation_error(f"found {describe(item)}{meant}; expected {join_or(_COMPONENT_KEYS)}", index)


def _component_keys(components: tuple[ComponentType, ...]) -> list[str]:
    return [component.key for component in components]


def _zenoh_config(value: object, info: ValidationInfo) -> Path | dict[str, Any]:
    """Return the path of Zenoh's configuration, or its keys, once Zenoh itself has read them.

    A relative path counts from ``folder`` in the validation's context; without one, no file is read.
    """
    match value:
        case dict():
            _ask_zenoh(lambda: zenoh.Config.from_json5(json.dumps(value, allow_nan=False)), "these keys")
            return value
        case Path():
            return value
        case str() if value and value.isprintable():
            folder: Path | None = (info.context or {}).get("folder")
            if folder is None:
                return Path(value)
            path = folder / value
            _ask_zenoh(lambda: zenoh.Config.from_file(path), f"the file {path}")
            return path
    raise validation_error(
        f"found {describe(value)}; expected a JSON5 file's path or a mapping with Zenoh's own keys"
    )


def _ask_zenoh(read: Callable[[], object], what: str) -> None:
    try:
        read()
    except (zenoh.ZError, TypeError, ValueError) as error:
        raise validation_error(f"Zenoh refuses {what}: {zenoh_reason(error)}") from None


def zenoh_reason(error: Exception) -> str:
    """Return the text of Zenoh's error on one line, without source locations and without secrets."""
    text = str(error)
    if message := _ZENOH_MESSAGE.search(text):
        text = f"line {message[2]}, column {message[3]}: " + re.sub(r"\\(.)", r"\1", message[1])
    text = re.sub(r"\s+at \S+\.rs:\d+\.?", "", text)
    # A drawing shows the line of the file that cannot be read, which may hold a password: its place
    # and what was expected remain. So does the type of a wrong value, without the value.
    text = re.sub(r"^ *--> (\d+):(\d+)", r"line \1, column \2:", text)
    text = re.sub(r"^ *(\d+ )?\|.*\n|^ *= ", "", text, flags=re.MULTILINE)
    text = re.sub(r"(invalid (?:type|value): [a-z ]+) (?:`[^`]*`|\"(?:[^\"\\]|\\.)*\")", r"\1", text)
    text = re.sub(r"\bSingle\(([^()]*)\)", r"\1", text)  # Rust's word for an endpoint without alternatives
    return " ".join(mask_secrets_in_text(text).split())


Components = Annotated[
    tuple[ComponentType, ...],
    PlainValidator(
        _components, json_schema_input_type=list[Literal["3d", "6d", "analog", "force", "event", "all"]]
    ),
    PlainSerializer(_component_keys),
]
"""YAML: [all] or a list of keys; kept in WIRE_ORDER."""

StreamRate = Annotated[
    Rate,
    PlainValidator(_rate, json_schema_input_type=Literal["all"] | FrequencyRate | DivisorRate),
    PlainSerializer(_rate_as_in_yaml),
]
"""YAML: all, {frequency_hz: NUMBER} or {divisor: WHOLE NUMBER}."""

Backlog = Annotated[Literal["latest", "all"], expects("latest or all")]

ServerByteOrder = Annotated[ByteOrder, expects("big or little")]

ZenohConfig = Annotated[
    Path | dict[str, Any], PlainValidator(_zenoh_config, json_schema_input_type=str | dict[str, Any])
]
"""YAML: a path, or a mapping."""

_RATES: Final = TypeAdapter(dict[str, Hertz])


def _max_rates(value: object) -> dict[ComponentType, float]:
    if not isinstance(value, dict):
        raise validation_error(f"found {describe(value)}; expected a mapping such as {{3d: 60}}, or {{}}")
    rates = {}
    for key, rate in value.items():
        if key not in COMPONENTS_BY_KEY and not isinstance(key, ComponentType):
            meant = spelling_hint(key, _COMPONENT_KEYS)
            raise validation_error(f"found {describe(key)}{meant}; expected {join_or(_COMPONENT_KEYS)}")
        component = key if isinstance(key, ComponentType) else COMPONENTS_BY_KEY[key]
        rates[component] = _RATES.validate_python({component.key: rate})[component.key]
    return rates


MaxRates = Annotated[
    dict[ComponentType, float],
    PlainValidator(_max_rates, json_schema_input_type=dict[Literal["3d", "6d", "analog", "force"], Hertz]),
    PlainSerializer(lambda rates: {component.key: rate for component, rate in rates.items()}),
]
"""YAML: {3d: NUMBER, …}."""
