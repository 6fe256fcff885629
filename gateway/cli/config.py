"""``rtc3d-gateway config``, and the configuration that the options of a command choose."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gateway.cli.options import ConfigOption, ServerOption
from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.errors import ConfigError
from gateway.logs.safe_text import safe_json
from gateway.rtc3d.packets import FIRST_PRINCIPLES_PORT

if TYPE_CHECKING:
    from gateway.config.loading import Configuration

app = typer.Typer(no_args_is_help=True, help="Check or show a configuration, or print the JSON schema.")


@app.command()
def check(
    file: Annotated[
        Path | None,
        typer.Argument(help=f"The configuration file to check; the default is {DEFAULT_CONFIG}."),
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The same as FILE.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing if the file is valid.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Check a configuration file and print every mistake with its line. Starts nothing."""
    from gateway.config.loading import read
    from gateway.outputs.registry import settings_type

    if file is not None and config is not None:
        raise typer.BadParameter("give the file once, as FILE or as --config FILE")
    path = chosen_file(file or config, None, wanted="FILE")
    try:
        names = [source.name for source in read(path, settings_type()).settings.sources]
    except ConfigError as error:
        if not as_json:
            raise
        _print_json(path, mistakes=str(error).splitlines())
        raise typer.Exit(2) from None
    if as_json:
        _print_json(path, sources=names)
    elif not quiet:
        sources = f"{len(names)} source{'' if len(names) == 1 else 's'}: {', '.join(names)}"
        print(f"{path or 'environment'}: valid; {sources}")


def _print_json(path: Path | None, *, sources: Sequence[str] = (), mistakes: Sequence[str] = ()) -> None:
    content = {
        "file": None if path is None else str(path),
        "is_valid": not mistakes,
        "sources": sources,
        "mistakes": mistakes,
    }
    print(safe_json(json.dumps(content, indent=2, ensure_ascii=False)))


@app.command()
def show(config: ConfigOption = None, server: ServerOption = None) -> None:
    """Print the effective configuration and where each value comes from. Secrets are masked."""
    from gateway.config.show import shown_configuration

    print(shown_configuration(configuration_from_options(config, server)), end="")


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors; same as config/gateway.schema.json."""
    from gateway.config.show import schema_text
    from gateway.outputs.registry import settings_type

    print(schema_text(settings_type()), end="")


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


def configuration_from_options(config: Path | None, server: str | None) -> "Configuration":
    """Return the configuration from ``--config``, ``--server`` or the default file, and the environment.

    Raises ConfigError if it is not valid; BadParameter as ``chosen_file`` does.
    """
    from gateway.config.loading import read, read_server
    from gateway.outputs.registry import settings_type

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
