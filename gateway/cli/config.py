"""``rtc3d-gateway config``: check or show a configuration, or print the JSON schema."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import ConfigOption, ServerOption
from gateway.config.files import DEFAULT_CONFIG
from gateway.errors import ConfigError
from gateway.logs.safe_text import safe_json

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
    from gateway.cli.configuration import chosen_file
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
    from gateway.cli.configuration import configuration_from_options
    from gateway.config.show import shown_configuration

    print(shown_configuration(configuration_from_options(config, server)), end="")


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors; same as config/gateway.schema.json."""
    from gateway.config.show import schema_text
    from gateway.outputs.registry import settings_type

    print(schema_text(settings_type()), end="")
