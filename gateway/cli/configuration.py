"""The configuration that the options of a command choose."""

import os
from pathlib import Path

import typer

from gateway.config.environment import VARIABLE_PREFIX
from gateway.config.loading import Configuration, read, read_server
from gateway.outputs.registry import settings_type
from gateway.rtc3d.default_ports import FIRST_PRINCIPLES_PORT


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
