"""What this version promises to programs and configurations, as plain values.

``PROMISES`` has a function for each promise that can be read from the program itself. A folder such as
``1.0`` has what they returned in that version, and what ``lab`` saw of a running gateway. ``comparing`` says
what breaks a promise. docs/reference/compatibility.md says the same in words.
"""

import inspect
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import rtc3d
import typer
from pydantic import BaseModel
from typer.core import TyperCommand, TyperGroup

from gateway import __version__
from gateway.config.loading import schema_text
from gateway.tools.cli.main import ALIASES, EXIT_STATUSES, app
from tests.support.configurations import MODEL
from tests.support.documents import ROOT

ALL_VERSIONS: Final = sorted(
    Path(__file__).parent.glob("[0-9]*.*"), key=lambda path: [int(number) for number in path.name.split(".")]
)
"""The folders of all versions, the oldest first: their takes can always be read."""

VERSIONS: Final = [each for each in ALL_VERSIONS if each.name.split(".")[0] == __version__.split(".")[0]]
"""Those that this version is compatible with: they have the same first number."""

PUBLIC: Final = {
    "gateway.client": {
        "Frame": "members",
        "GatewayAddress": "call",
        "GatewayClient": "call members",
        "Live": "members",
        "Messages": "call",
        "live": "call",
    },
    "gateway.takes": {
        "ParametersEntry": "members",
        "Series": "members",
        "Take": "members",
        "TakeSource": "members",
        "open_take": "call",
    },
    "gateway.errors": {
        "ConfigError": "call",
        "GatewayError": "call",
        "OutputError": "call",
        "QueryError": "call",
    },
    "gateway.config.settings": {"OutputSettings": "members"},
    "gateway.messages.decode": {"decode": "call", "json_text": "call"},
    "gateway.messages.topics": {"Topic": "members"},
    "gateway.outputs.contract": {
        "Answer": "members",
        "FramePublisher": "members",
        "IgnoringPublisher": "call members",
        "LazyPayload": "members",
        "Output": "members",
        "OutputHealth": "call",
        "Publisher": "members",
        "QueryService": "members",
        "ServerFile": "members",
        "ServerParameters": "members",
    },
    "gateway.outputs.kind": {
        "DemoSide": "call",
        "OutputKind": "call",
        "Subscription": "members",
        "SubscriptionRequest": "members",
    },
}
"""The Python API: how to call something, or what members it has.

First that for programs beside a gateway and for readers of takes, then that for packages with outputs.
"""


def messages() -> dict[str, Any]:
    """Return the fingerprint and the fields of each message type, and of the types that they contain."""
    return {
        name: {
            "fingerprint": message_type._get_packed_fingerprint().hex(),
            "fields": " ".join(
                f"{kind} {field}{'' if size is None else list(size)};"
                for field, kind, size in zip(
                    message_type.__slots__,
                    message_type.__typenames__,
                    message_type.__dimensions__,
                    strict=True,
                )
            ),
        }
        for name, message_type in vars(rtc3d).items()
        if name.endswith("_t")
    }


def metrics() -> dict[str, Any]:
    """Return type, labels and unit of each metric in the reference, which another test keeps complete."""
    text = (ROOT / "docs/reference/metrics.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| ([\w, ]*) ?\| (\w*) ?\|", text, re.MULTILINE)
    return {
        name: {"type": kind, "labels": " ".join(sorted(labels.replace(",", " ").split())), "unit": unit}
        for name, kind, labels, unit in rows
    }


def commands() -> dict[str, Any]:
    """Return the arguments and options of each command, and the exit statuses."""
    group = typer.main.get_command(app)
    described = {name: _command(command) for name, command in _commands(group, "rtc3d-gateway")}
    options: dict[str, Any] = {option: {} for parameter in group.params for option in parameter.opts}
    statuses = {"success": 0, "failure": 1, "wrong command line or configuration": 2, **EXIT_STATUSES}
    return {"commands": described, "aliases": sorted(ALIASES), "options": options, "exit statuses": statuses}


def _commands(command: object, name: str) -> Iterator[tuple[str, TyperCommand]]:
    if isinstance(command, TyperGroup):
        context = typer.Context(command)
        for sub_name in command.list_commands(context):
            yield from _commands(command.get_command(context, sub_name), f"{name} {sub_name}")
    else:
        assert isinstance(command, TyperCommand)
        yield name, command


def _command(command: TyperCommand) -> dict[str, Any]:
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    options = [each for each in command.params if each.param_type_name == "option"]
    return {
        "arguments": {each.name: {"place": place, **_value(each)} for place, each in enumerate(arguments)},
        "options": {name: _value(each) for each in options for name in (*each.opts, *each.secondary_opts)},
        "required": " ".join(sorted(str(each.name) for each in command.params if each.required)),
    }


def _value(parameter: Any) -> dict[str, Any]:
    kind, default = parameter.type_descriptor.annotation, parameter.default
    is_choice = isinstance(kind, type) and issubclass(kind, Enum)
    value = {
        "type": "one of" if is_choice else getattr(kind, "__name__", str(kind)),
        "default": default.value if isinstance(default, Enum) else default,
        "can be repeated": parameter.nargs != 1 or getattr(parameter, "multiple", False),
    }
    return value | ({"values": [member.value for member in kind]} if is_choice else {})


def python() -> dict[str, Any]:
    """Return what PUBLIC says of each name there."""
    return {
        module: {
            name: {
                part: {"call": _call, "members": _members}[part](getattr(import_module(module), name))
                for part in parts.split()
            }
            for name, parts in names.items()
        }
        for module, names in PUBLIC.items()
    }


def _members(item: type) -> dict[str, Any]:
    """Return the public members of a class, and how to call its methods."""
    annotations = (inspect.get_annotations(base) for base in item.__mro__[:-1])
    names = {*dir(item), *itertools.chain.from_iterable(annotations)}
    members = {name: getattr(item, name, None) for name in names - _INHERITED if not name.startswith("_")}
    return {
        # A class outside of the gateway that lacks a new abstract method could not be used any more.
        "must be implemented": " ".join(sorted(getattr(item, "__abstractmethods__", ()))),
        **{name: _call(member) if inspect.isroutine(member) else {} for name, member in members.items()},
    }


_INHERITED: Final = {*dir(tuple), *dir(BaseModel), "model_config"}


def _call(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the parameters of a function: their places, and the defaults; and which are required."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # a function of C
        return {}
    named = [each for each in parameters if each.name != "self"]
    return {
        "parameters": {
            each.name: {
                "place": "by name" if each.kind is each.KEYWORD_ONLY else place,
                "default": None if each.default is each.empty else _plain(each.default),
            }
            for place, each in enumerate(named)
        },
        "required": " ".join(
            each.name
            for each in named
            if each.default is each.empty and each.kind not in {each.VAR_POSITIONAL, each.VAR_KEYWORD}
        ),
    }


def _plain(value: object) -> object:
    return value if isinstance(value, bool | int | float | str) else re.sub(r" at 0x\w+", "", repr(value))


def configuration() -> dict[str, Any]:
    """Return the JSON schema of configurations: keys, values that each accepts, defaults."""
    schema: dict[str, Any] = json.loads(schema_text(MODEL))
    return schema


PROMISES: Final[Mapping[str, Callable[[], dict[str, Any]]]] = {
    "messages": messages,
    "metrics": metrics,
    "commands": commands,
    "python": python,
}
"""Each promise by its name, which is the name of its file in the folder of a version.

Whatever was in there must be there unchanged; anything may be added.
"""


def recorded(version: Path, name: str) -> Any:
    """Return what a version has recorded."""
    return json.loads((version / f"{name}.json").read_text(encoding="utf-8"))
