"""Options that several commands share, and objects of options that belong together.

This module imports nothing that takes long, so that ``COMMAND --help`` is quick: the checks of values import
what they need.
"""

import functools
import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

import typer

from gateway.cli.completion import one_of, source_names
from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.config.words import describe, join_or
from gateway.errors import QueryError
from gateway.logs.log_format import LogFormat, LogLevel
from gateway.messages.topics import MAX_LABEL_LENGTH
from gateway.rtc3d.component_types import COMPONENTS_BY_KEY

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

NoProgressOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress, only problems.")]


def _host() -> Any:
    from gateway.config.values import Host

    return Host


def _source_name() -> Any:
    from gateway.config.values import SourceName

    return SourceName


def _key_prefix() -> Any:
    from gateway.outputs.zenoh.settings import KeyPrefix

    return KeyPrefix


def _lcm_url() -> Any:
    from gateway.outputs.lcm.settings import LcmUrl

    return LcmUrl


def _checked(kind: Callable[[], Any]) -> Callable[[str | None], str | None]:
    """Return a callback for an option whose value must be valid as a type of the configuration."""

    def check(text: str | None) -> str | None:
        if text is None:
            return None
        from pydantic import TypeAdapter, ValidationError

        try:
            return str(TypeAdapter(kind()).validate_python(text))
        except ValidationError as error:
            raise typer.BadParameter(error.errors(include_url=False)[0]["msg"]) from None

    return check


checked_host = _checked(_host)
"""Checks that an option is a host name or an IP address."""

checked_key_prefix = _checked(_key_prefix)
"""Checks that an option is the beginning of a Zenoh key."""

_checked_source = _checked(_source_name)
_checked_lcm_url = _checked(_lcm_url)


def _one_of(components: Sequence[str]) -> Callable[[str | None], str | None]:
    def check(text: str | None) -> str | None:
        if text is not None and text not in components:
            raise typer.BadParameter(f"found {describe(text)}; expected {join_or(components)}")
        return text

    return check


def _checked_component(text: str | None) -> str | None:
    label = (text or "").removeprefix(_POSE)
    if label != text and text is not None and 0 < len(label) <= MAX_LABEL_LENGTH and label.isprintable():
        return text
    return _one_of(_COMPONENTS)(text)


def _checked_each(
    check: Callable[[str | None], str | None],
) -> Callable[[list[str] | None], list[str] | None]:
    """Return a callback for an option that can be repeated."""

    def check_each(texts: list[str] | None) -> list[str] | None:
        for text in texts or ():
            check(text)
        return texts

    return check_each


def check_exists(option: str, path: Path | None) -> None:
    """Raise BadParameter if there is no file of this name. Not a callback: parsing must not read the disk."""
    if path is not None and not path.exists():
        raise typer.BadParameter(f"{option}: {path} does not exist")


def checked_take_name(text: str | None) -> str | None:
    """Check that an argument can be the name of a take."""
    if text is None:
        return None
    from gateway.takes.files.new_file import check_name

    try:
        check_name(text)
    except QueryError as error:
        raise typer.BadParameter(str(error)) from None
    return text


def _checked_endpoint(text: str | None) -> str | None:
    if text is not None and not (text.isprintable() and re.fullmatch(r"[\w-]+/.{1,1000}", text)):
        raise typer.BadParameter(f"found {describe(text)}; expected an endpoint such as tcp/192.0.2.5:7447")
    return text


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
        callback=_checked_each(_checked_source),
        autocompletion=source_names,
        help="Only this source; can be repeated. The default is all sources.",
    ),
]
ComponentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--component",
        callback=_checked_each(_one_of(_RECORDED)),
        autocompletion=one_of(_RECORDED),
        help=f"Only this: {join_or(_RECORDED)}; can be repeated.",
    ),
]
ConnectOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_endpoint,
        help="Zenoh endpoint of the gateway or router, for example tcp/192.0.2.5:7447.",
    ),
]
ListenOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked_endpoint,
        help="Zenoh endpoint to listen on, for example tcp/127.0.0.1:7448.",
    ),
]
ZenohConfigOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Zenoh's configuration (JSON5) for this command's session: endpoints, certificates, password.",
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
        callback=checked_key_prefix,
        help="The gateway's prefix; the default is mocap on Zenoh, MOCAP on LCM.",
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


@dataclass(frozen=True)
class SceneOptions:
    """The scene of a simulated server."""

    markers: Annotated[int, typer.Option(min=0, max=10_000, help="Markers in the synthetic scene.")] = 24
    tools: Annotated[int, typer.Option(min=0, max=1_000, help="6D tools in the synthetic scene.")] = 4
    analog: Annotated[
        int, typer.Option(min=0, max=10_000, help="Analog channels in the synthetic scene.")
    ] = 16
    plates: Annotated[int, typer.Option(min=0, max=100, help="Force plates in the synthetic scene.")] = 2
    rate: Annotated[float, typer.Option(min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")] = (
        200.0
    )
    analog_rate: Annotated[
        float, typer.Option(min=0.1, max=100_000, help="Analog and force samples per second, in Hz.")
    ] = 2000.0
    c3d: Annotated[
        Path | None, typer.Option("--c3d", help="Play this C3D file instead of a synthetic scene.")
    ] = None

    def settings(self) -> dict[str, Any]:
        """Return the settings of the synthetic scene by their names."""
        return {
            "markers": self.markers,
            "tools": self.tools,
            "analog": self.analog,
            "plates": self.plates,
            "rate_hz": self.rate,
            "analog_rate_hz": self.analog_rate,
        }
