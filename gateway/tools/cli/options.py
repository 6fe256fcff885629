"""Options that several commands share: their checks, and objects of several options.

This module imports nothing that takes long, so that ``COMMAND --help`` is quick: the checks of values import
what they need.
"""

import functools
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

import typer

from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.config.words import describe, join_or
from gateway.errors import ConfigError, QueryError
from gateway.messages.topics import MAX_LABEL_LENGTH
from gateway.rtc3d.component_types import COMPONENTS_BY_KEY
from gateway.runtime.log_format import LogFormat, LogLevel
from gateway.tools.cli.completion import one_of, source_names

if TYPE_CHECKING:
    from gateway.client.client import GatewayAddress, GatewayClient
    from gateway.takes.files.description import TakeDetails

_RECORDED: Final = (*COMPONENTS_BY_KEY, "status", "clock", "parameters")
"""The values of ``--component`` for commands that read or write recordings."""

_COMPONENTS: Final = (*_RECORDED, "c3d")
_POSE: Final = "6d/"

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE",
        help=f"The configuration file (YAML); the default is {DEFAULT_CONFIG}. Environment variables "
        f"{VARIABLE_PREFIX}… override it or replace it.",
    ),
]
ServerOption = Annotated[
    str | None,
    typer.Option(
        metavar="HOST[:PORT]",
        help="HOST[:PORT] of an RT server, for a quick try without a configuration file.",
    ),
]

FromOption = Annotated[
    float | None, typer.Option("--from", min=0, help="Where to begin, in s from the take's first message.")
]
ToOption = Annotated[
    float | None,
    typer.Option("--to", min=0, help="Where to end, in s from the first message; the default is its end."),
]
NoProgressOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress, only problems.")]


_Callback = Callable[[Any], Any]
"""The callback of an option: it takes None if the option is not given, or a list if it can be repeated."""


def _on_each(check: Callable[[str], str | None]) -> _Callback:
    """Return a callback that checks each value of an option; ``check`` may return another one instead."""

    def check_all(value: Any) -> Any:
        if isinstance(value, str):
            return check(value) or value
        for text in value or ():
            check(text)
        return value

    return check_all


def _checked(module: str, name: str) -> _Callback:
    """Return a callback for an option whose value must be valid as this type of the configuration."""

    def check(text: str) -> str:
        from gateway.config.section import validated

        try:
            return str(validated(getattr(import_module(module), name), text))
        except ConfigError as error:
            raise typer.BadParameter(str(error)) from None

    return _on_each(check)


checked_host = _checked("gateway.config.values", "Host")
"""Checks that an option is a host name or an IP address."""

checked_key_prefix = _checked("gateway.outputs.zenoh.settings", "KeyPrefix")
"""Checks that an option is the beginning of a Zenoh key."""

_checked_source = _checked("gateway.config.values", "SourceName")
_checked_lcm_url = _checked("gateway.outputs.lcm.settings", "LcmUrl")


def _check_word(text: str, words: Sequence[str]) -> None:
    if text not in words:
        raise typer.BadParameter(f"found {describe(text)}; expected {join_or(words)}")


@_on_each
def _checked_component(text: str) -> None:
    label = text.removeprefix(_POSE)
    if label == text or not (0 < len(label) <= MAX_LABEL_LENGTH and label.isprintable()):
        _check_word(text, _COMPONENTS)


@_on_each
def checked_take_name(text: str) -> None:
    """Check that an argument can be the name of a take."""
    from gateway.messages.take_names import check_name

    try:
        check_name(text)
    except QueryError as error:
        raise typer.BadParameter(str(error)) from None


@_on_each
def _checked_endpoint(text: str) -> None:
    if not (text.isprintable() and re.fullmatch(r"[\w-]+/.{1,1000}", text)):
        raise typer.BadParameter(f"found {describe(text)}; expected an endpoint such as tcp/192.0.2.5:7447")


def check_exists(option: str, path: Path | None) -> None:
    """Raise BadParameter if there is no file of this name. Not a callback: parsing must not read the disk."""
    if path is not None and not path.exists():
        raise typer.BadParameter(f"{option}: {path} does not exist")


SourceOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_source,
        autocompletion=source_names,
        help="Only this source; the default is all sources.",
    ),
]
ComponentOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_component,
        autocompletion=one_of(_COMPONENTS),
        help=f"Only this: {join_or(_COMPONENTS)}; 6d/LABEL for the pose of one tool, 6d/* for each tool's.",
    ),
]
SourcesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--source",
        callback=_checked_source,
        autocompletion=source_names,
        help="Only this source; can be repeated.",
    ),
]
ComponentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--component",
        callback=_on_each(lambda text: _check_word(text, _RECORDED)),
        autocompletion=one_of(_RECORDED),
        help=f"Only this: {join_or(_RECORDED)}; can be repeated.",
    ),
]
ZenohOption = Annotated[bool, typer.Option("--zenoh", help="Use Zenoh (the default).")]
LcmOption = Annotated[bool, typer.Option("--lcm", help="Use LCM instead of Zenoh.")]
ConnectOption = Annotated[
    str | None,
    typer.Option(
        metavar="ENDPOINT",
        callback=_checked_endpoint,
        help="Zenoh endpoint of the gateway or router, for example tcp/192.0.2.5:7447.",
    ),
]
ListenOption = Annotated[
    str | None,
    typer.Option(
        metavar="ENDPOINT",
        callback=_checked_endpoint,
        help="Zenoh endpoint to listen on, for example tcp/127.0.0.1:7448.",
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Zenoh's configuration (JSON5): certificates, password, endpoints unless --connect is given.",
    ),
]
UrlOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_lcm_url, help="LCM URL; the default is $LCM_DEFAULT_URL, else LCM's default URL."
    ),
]
PrefixOption = Annotated[
    str | None,
    typer.Option(
        callback=checked_key_prefix, help="The gateway's prefix; the default is mocap on Zenoh, MOCAP on LCM."
    ),
]


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command one option for each field of the option objects that it takes.

    An option object is an instance of one of the classes below. Typer has nothing like it.
    """
    parameters = inspect.signature(command).parameters
    objects: dict[str, Any] = {
        name: each.annotation for name, each in parameters.items() if is_dataclass(each.annotation)
    }
    options: list[inspect.Parameter] = []
    for name, parameter in parameters.items():
        options += _fields(objects[name]) if name in objects else [parameter]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        for name, kind in objects.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in _fields(kind)})
        command(**values)

    keywords = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    return run


def _fields(kind: Any) -> list[inspect.Parameter]:
    """Return the fields of an option object that are options."""
    fields = inspect.signature(kind).parameters.values()
    return [field for field in fields if get_origin(field.annotation) is Annotated]


@dataclass(frozen=True)
class AddressOptions:
    """Where to find gateways."""

    connect: ConnectOption = None
    zenoh_config: ZenohConfigOption = None
    url: UrlOption = None
    queries_url: str | None = None
    """An option of those commands only that ask on LCM."""

    prefix: PrefixOption = None

    def check(self, *, lcm: bool) -> None:
        """Raise BadParameter if there are options for Zenoh with ``--lcm``, or for LCM without it."""
        if lcm and (self.connect is not None or self.zenoh_config is not None):
            raise typer.BadParameter("--connect and --zenoh-config are for Zenoh, not for --lcm")
        for name, value in (("--url", self.url), ("--queries-url", self.queries_url)):
            if value is not None and not lcm:
                raise typer.BadParameter(f"{name} is for LCM; add --lcm")

    def address(self, *, lcm: bool) -> "GatewayAddress":
        """Return where to find gateways, on LCM or on Zenoh."""
        from gateway.client.client import GatewayAddress

        return GatewayAddress(lcm, self.connect, self.zenoh_config, self.url, self.prefix, self.queries_url)


@dataclass(frozen=True)
class QueryOptions(AddressOptions):
    """Where to find gateways, and how long to wait for their replies."""

    queries_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            callback=_checked_lcm_url,
            help="LCM URL of requests and replies: the gateway's lcm.queries_url.",
        ),
    ] = None
    timeout: Annotated[float, typer.Option(min=0.1, help="How many seconds to wait for replies.")] = 5.0

    def client(self, *, lcm: bool) -> "GatewayClient":
        """Return a client of these gateways. Raises BadParameter."""
        from gateway.client.client import GatewayClient

        self.check(lcm=lcm)
        return GatewayClient(self.address(lcm=lcm), self.timeout)


@dataclass(frozen=True)
class DetailsOptions:
    """Who and what a recording is about."""

    subject: Annotated[str | None, typer.Option(help="Who is recorded, such as S01.")] = None
    session: Annotated[str | None, typer.Option(help="The session of the subject, such as baseline.")] = None
    note: Annotated[str | None, typer.Option(help="Anything else that belongs to the recording.")] = None

    def given(self) -> dict[str, str]:
        """Return the details whose options are given, by name; "" takes one away. Raises BadParameter."""
        return {
            name: text for name, text in self.checked()._asdict().items() if getattr(self, name) is not None
        }

    def checked(self) -> "TakeDetails":
        """Return the details. Raises BadParameter."""
        from gateway.takes.files.description import TakeDetails

        try:
            return TakeDetails(self.subject or "", self.session or "", self.note or "").checked()
        except QueryError as error:
            raise typer.BadParameter(str(error)) from None


@dataclass(frozen=True)
class LogOptions:
    """What to log, and how."""

    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Log everything; short for --log-level debug.")
    ] = False
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Log problems only; short for --log-level warning.")
    ] = False
    log_level: Annotated[
        LogLevel,
        typer.Option(
            case_sensitive=False,
            metavar="LEVEL",
            help="The lowest level to log: debug, info, warning or error.",
        ),
    ] = LogLevel.INFO
    log_format: Annotated[
        LogFormat,
        typer.Option(
            case_sensitive=False,
            metavar="FORMAT",
            help="text, json or journal; auto means journal under systemd, otherwise text.",
        ),
    ] = LogFormat.AUTO

    def chosen_level(self) -> LogLevel:
        """Return the level to log; raises BadParameter if the three options contradict each other."""
        if self.verbose + self.quiet + (self.log_level is not LogLevel.INFO) > 1:
            raise typer.BadParameter("give only one of --log-level, --verbose and --quiet")
        return LogLevel.DEBUG if self.verbose else LogLevel.WARNING if self.quiet else self.log_level
