"""The command line's part about configurations: which one to use, and ``rtc3d-gateway config``."""

import os
from pathlib import Path
from typing import Annotated, Final

import typer

from gateway.config.environment import VARIABLE_PREFIX
from gateway.config.loading import Configuration, read, read_server
from gateway.config.schema import schema_text
from gateway.config.show import shown_configuration

INSTALLED_CONFIG: Final = Path("/etc/rtc3d-gateway/gateway.yaml")

_DEFAULT_PORT: Final = 3020

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        help=f"The configuration, YAML; see config/gateway.yaml. Variables {VARIABLE_PREFIX}… stand over it, "
        "and can do without it."
    ),
]
ServerOption = Annotated[
    str | None, typer.Option(help="For a first try: HOST[:PORT] of an RT server, all else as by default.")
]

app = typer.Typer(no_args_is_help=True, help="Show the configuration in effect, or what one may hold.")


def configuration(config: Path | None, server: str | None) -> Configuration:
    """Return the configuration of a command's options ``--config`` and ``--server``.

    Raises ConfigError if it cannot be used, BadParameter if there is none, or two.
    """
    if server is not None and config is None:
        return read_server(*_host_and_port(server))
    if server is None and (
        config is not None or any(name.startswith(VARIABLE_PREFIX) for name in os.environ)
    ):
        return read(config)
    raise typer.BadParameter("give either --config FILE or --server HOST[:PORT]")


def _host_and_port(server: str) -> tuple[str, int]:
    """Return the parts of HOST, HOST:PORT or [IPV6]:PORT."""
    if server.startswith("["):
        host, _, rest = server[1:].partition("]")
        port = rest.removeprefix(":")
    elif server.count(":") == 1:
        host, _, port = server.partition(":")
    else:
        host, port = server, ""
    if not port:
        return host, _DEFAULT_PORT
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise typer.BadParameter(f"{server!r}: the port is a number from 1 to 65535")
    return host, int(port)


@app.command("show")
def show_command(config: ConfigOption = None, server: ServerOption = None) -> None:
    """Print the configuration in effect, and where each value is from; secrets are not shown."""
    print(shown_configuration(configuration(config, server)), end="")


@app.command("schema")
def schema_command() -> None:
    """Print the JSON schema of configurations, for editors; config/gateway.schema.json holds it."""
    print(schema_text(), end="")
