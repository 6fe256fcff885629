"""Options that several commands share."""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from pydantic import TypeAdapter, ValidationError

from gateway.config.environment import VARIABLE_PREFIX
from gateway.config.loading import Configuration, read, read_server
from gateway.config.section import describe, join_or
from gateway.config.values import Host, SourceName
from gateway.outputs.lcm.settings import LcmUrl
from gateway.outputs.registry import settings_type
from gateway.outputs.zenoh.settings import KeyPrefix
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.rtc3d.default_ports import FIRST_PRINCIPLES_PORT
from gateway.service.log_format import LogFormat, LogLevel

_RECORDED: Final = (*COMPONENTS_BY_KEY, "status", "clock", "parameters")
"""What recordings have."""

_COMPONENTS: Final = (*_RECORDED, "c3d")

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        help="The configuration file (YAML); see config/gateway.yaml. Environment variables "
        f"{VARIABLE_PREFIX}… override it or replace it."
    ),
]
ServerOption = Annotated[
    str | None,
    typer.Option(help="HOST[:PORT] of an RT server, for a quick try without a configuration file."),
]

LogLevelOption = Annotated[
    LogLevel,
    typer.Option(case_sensitive=False, help="The lowest level to log: debug, info, warning or error."),
]
LogFormatOption = Annotated[
    LogFormat,
    typer.Option(
        case_sensitive=False, help="text, json or journal; auto means journal under systemd, otherwise text."
    ),
]

MarkersOption = Annotated[int, typer.Option(min=0, max=10_000, help="Markers in the synthetic scene.")]
ToolsOption = Annotated[int, typer.Option(min=0, max=1_000, help="6D tools in the synthetic scene.")]
AnalogOption = Annotated[int, typer.Option(min=0, max=10_000, help="Analog channels in the synthetic scene.")]
PlatesOption = Annotated[int, typer.Option(min=0, max=100, help="Force plates in the synthetic scene.")]
RateOption = Annotated[float, typer.Option(min=0.1, max=10_000, help="3D and 6D frames per second, in Hz.")]
AnalogRateOption = Annotated[
    float, typer.Option(min=0.1, max=100_000, help="Analog and force samples per second, in Hz.")
]
C3dOption = Annotated[
    Path | None, typer.Option("--c3d", help="Play this C3D file instead of a synthetic scene.")
]


def _checked(kind: Any) -> Callable[[str | None], str | None]:
    """Return a callback for an option whose value must be valid as ``kind``, a type of the configuration."""
    adapter = TypeAdapter(kind)

    def check(text: str | None) -> str | None:
        try:
            return None if text is None else adapter.validate_python(text)
        except ValidationError as error:
            raise typer.BadParameter(error.errors(include_url=False)[0]["msg"]) from None

    return check


def _one_of(components: Sequence[str]) -> Callable[[str | None], str | None]:
    def check(text: str | None) -> str | None:
        if text is not None and text not in components:
            raise typer.BadParameter(f"found {describe(text)}; expected {join_or(components)}")
        return text

    return check


def _checked_each(
    check: Callable[[str | None], str | None],
) -> Callable[[list[str] | None], list[str] | None]:
    """Return a callback for an option that can be repeated."""

    def check_each(texts: list[str] | None) -> list[str] | None:
        for text in texts or ():
            check(text)
        return texts

    return check_each


def _checked_endpoint(text: str | None) -> str | None:
    if text is not None and not (text.isprintable() and re.fullmatch(r"[\w-]+/.{1,1000}", text)):
        raise typer.BadParameter(f"found {describe(text)}; expected an endpoint such as tcp/192.0.2.5:7447")
    return text


SourceOption = Annotated[
    str | None,
    typer.Option(callback=_checked(SourceName), help="Only this source; the default is all sources."),
]
ComponentOption = Annotated[
    str | None,
    typer.Option(callback=_one_of(_COMPONENTS), help=f"Only this: {join_or(_COMPONENTS)}."),
]
SourcesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--source",
        callback=_checked_each(_checked(SourceName)),
        help="Only this source; can be repeated. The default is all sources.",
    ),
]
ComponentsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--component",
        callback=_checked_each(_one_of(_RECORDED)),
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
        callback=_checked(LcmUrl), help="LCM URL; the default is $LCM_DEFAULT_URL, else LCM's default URL."
    ),
]
PrefixOption = Annotated[
    str | None,
    typer.Option(
        callback=_checked(KeyPrefix),
        help="The gateway's prefix; the default is mocap on Zenoh, MOCAP on LCM.",
    ),
]
QueriesUrlOption = Annotated[
    str | None,
    typer.Option(
        metavar="URL",
        callback=_checked(LcmUrl),
        help="LCM URL of requests and replies: the gateway's lcm.queries_url.",
    ),
]


checked_host = _checked(Host)
"""Checks that an option is a host name or an IP address."""

checked_key_prefix = _checked(KeyPrefix)
"""Checks that an option is the beginning of a Zenoh key."""


def configuration_from_options(config: Path | None, server: str | None) -> Configuration:
    """Return the configuration from ``--config`` or ``--server``, and the environment.

    Raises ConfigError if it is not valid; BadParameter if both options are given, or if neither is given and
    no environment variable is set.
    """
    if server is not None and config is None:
        return read_server(*_host_and_port(server), settings_type())
    if server is None and (
        config is not None or any(name.startswith(VARIABLE_PREFIX) for name in os.environ)
    ):
        return read(config, settings_type())
    raise typer.BadParameter("give either --config FILE or --server HOST[:PORT]")


def _host_and_port(server: str) -> tuple[str, int]:
    """Split HOST, HOST:PORT or [IPV6]:PORT; the default port is that of First Principles."""
    if server.startswith("["):
        host, _, rest = server[1:].partition("]")
        port = rest.removeprefix(":")
    elif server.count(":") == 1:
        host, _, port = server.partition(":")
    else:
        host, port = server, ""
    if not port:
        return host, FIRST_PRINCIPLES_PORT
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"{server!r}: the port must be a number from 1 to 65535")
    return host, int(port)
