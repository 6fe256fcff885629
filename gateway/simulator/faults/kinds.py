"""All kinds of faults by name, and the parsing of faults from mappings and from the command line."""

import re
from collections.abc import Iterator
from typing import Any, Final

import yaml
from pydantic import BaseModel, ValidationError

from gateway.config.section import validation_error
from gateway.config.words import describe, spelling_hint
from gateway.errors import ConfigError
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.frame_faults import FRAME_FAULTS
from gateway.simulator.faults.momentary_faults import MOMENTARY_FAULTS
from gateway.simulator.faults.parameters import parameter_text
from gateway.simulator.faults.reply_faults import REPLY_FAULTS
from gateway.simulator.faults.server_faults import SERVER_FAULTS
from gateway.simulator.faults.stream_faults import STREAM_FAULTS

KINDS: Final[dict[str, type[Fault]]] = {
    fault.kind: fault
    for fault in (*SERVER_FAULTS, *REPLY_FAULTS, *FRAME_FAULTS, *STREAM_FAULTS, *MOMENTARY_FAULTS)
}
"""All kinds by name, in the order in which they act on the bytes of a connection."""

COMMON_PARAMETERS: Final = {
    "at_s": "begin this many seconds after the start; without at_s and every_s, begin at the start",
    "every_s": "begin repeatedly, at intervals of this many seconds, varied at random by up to half",
    "for_s": "last this many seconds; without for_s, last until the simulator ends",
    "times": "happen at most this many times: packets, replies or reads changed; for other kinds, beginnings",
    "connection": "affect only the n-th connection since the server's start; without it, affect all",
}
"""The parameters that many kinds have, and what they do."""

_NAMES: Final = ", ".join(KINDS)
_COMMAS: Final = re.compile(r",(?![^\[]*\])")  # except commas in a list


def parse_fault(text: str) -> Fault:
    """Return the fault in the form ``KIND,NAME=VALUE,…``, such as ``restart,away_s=2,scene.markers=12``.

    Lists are written ``[a,b]``. Raises ConfigError, one line per mistake.
    """
    kind, *assignments = _COMMAS.split(text)
    values: dict[str, Any] = {"fault": kind}
    for assignment in assignments:
        path, equals, value = assignment.partition("=")
        *mappings, name = path.split(".")
        target = values
        for mapping in mappings:
            target = target.setdefault(mapping, {})
            if not isinstance(target, dict):
                raise ConfigError(
                    f"fault {text!r}: {mapping} has both a value and keys; expected only one of them"
                )
        if not equals or name in target:
            raise ConfigError(f"fault {text!r}: found {assignment!r}; expected NAME=VALUE, each name once")
        target[name] = _value(value)
    try:
        return validate_fault(values)
    except ValidationError as error:
        lines = []
        for details in error.errors(include_url=False):
            where = ".".join(map(str, details["loc"]))
            lines.append(f"fault {text!r}: {where}: {details['msg']}")
        raise ConfigError("\n".join(lines)) from None


def validate_fault(value: object) -> Fault:
    """Return the fault that a mapping describes: its kind under the key ``fault``, and its parameters.

    Raises pydantic's ValidationError.
    """
    match value:
        case Fault():
            return value
        case {"fault": str(kind), **parameters} if kind in KINDS:
            return KINDS[kind].model_validate(parameters)
        case {"fault": kind}:
            raise validation_error(
                f"found {describe(kind)}{spelling_hint(kind, KINDS)}; expected {_NAMES}", "fault"
            )
    raise validation_error(f"found {describe(value)}; expected a mapping with the key fault, one of {_NAMES}")


def summary_of(kind: type[Fault]) -> str:
    """Return one sentence that describes what happens."""
    return (kind.__doc__ or "").partition("\n")[0]


def parameters_of(kind: type[Fault]) -> Iterator[tuple[str, str, str]]:
    """Yield name, default ("" for none) and description of each parameter except the common ones."""
    for name, field in kind.model_fields.items():
        if name not in COMMON_PARAMETERS:
            default = field.get_default()
            has_text = not field.is_required() and not isinstance(default, BaseModel)
            yield name, parameter_text(default) if has_text else "", field.description or ""


def describe_kinds() -> str:
    """Return a text for the terminal that describes every kind and its parameters."""
    lines = []
    for name, kind in KINDS.items():
        common = [key for key in ("for_s", "connection") if key in kind.model_fields]
        lines.append(f"{name}{''.join(f' [{key}]' for key in common)}")
        lines.append(f"    {summary_of(kind)}")
        for key, default, text in parameters_of(kind):
            lines.append(f"    {key}{'=' if default else ''}{default}  {text}")
    lines += [
        "",
        "Every kind has at_s, every_s and times; for_s and connection only where they follow its name:",
    ]
    lines += [f"    {key}  {text}" for key, text in COMMON_PARAMETERS.items()]
    return "\n".join(lines)


def _value(text: str) -> object:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text
