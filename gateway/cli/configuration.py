"""The configuration that the options of a command choose."""

import os
from pathlib import Path

import typer

from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.config.loading import Configuration, read, read_server
from gateway.outputs.registry import settings_type
from gateway.rtc3d.default_ports import FIRST_PRINCIPLES_PORT


def chosen_file(
    config: Path | None, server: str | None, *, wanted: str = "either --config FILE or --server HOST[:PORT]"
) -> Path | None:
    """Return the configuration file to read: that of ``--config``, or the default if there is neither option.

    None means ``--server``, or that environment variables alone are the configuration. Raises BadParameter if
    both options are given, or if there is nothing to read; ``wanted`` is what should have been given.
    """
    if config is not None and server is not None:
        raise typer.BadParameter(f"give {wanted}")
    if config is not None or server is not None:
        return config
    if DEFAULT_CONFIG.exists():
        return DEFAULT_CONFIG
    if not any(name.startswith(VARIABLE_PREFIX) for name in os.environ):
        raise typer.BadParameter(f"give {wanted}; the default, {DEFAULT_CONFIG}, does not exist")
    return None


def configuration_from_options(config: Path | None, server: str | None) -> Configuration:
    """Return the configuration from ``--config``, ``--server`` or the default file, and the environment.

    Raises ConfigError if it is not valid; BadParameter as ``chosen_file`` does.
    """
    file = chosen_file(config, server)
    if server is not None:
        return read_server(*_host_and_port(server), settings_type())
    return read(file, settings_type())


def _host_and_port(server: str) -> tuple[str, int]:
    """Split HOST, HOST:PORT or [IPV6]:PORT; the default port is that of First Principles."""
    if server.startswith("["):
        host, _, rest = server[1:].partition("]")
        port = rest.removeprefix(":")
    elif server.count(":") == 1:
        host, _, port = server.partition(":")
    else:
        host, port = server, ""
    if not host:
        raise typer.BadParameter(f"{server!r}: the host is missing; give HOST or HOST:PORT")
    if not port:
        return host, FIRST_PRINCIPLES_PORT
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"{server!r}: the port must be a number from 1 to 65535")
    return host, int(port)
