"""``rtc3d-gateway config``: check or show a configuration, or print the JSON schema."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import ConfigOption, ServerOption

app = typer.Typer(no_args_is_help=True, help="Check or show a configuration, or print the JSON schema.")


@app.command()
def check(file: Annotated[Path, typer.Argument(help="The configuration file to check.")]) -> None:
    """Check a configuration file and print every mistake with its line. Starts nothing."""
    from gateway.config.loading import read
    from gateway.outputs.registry import settings_type

    names = [source.name for source in read(file, settings_type()).settings.sources]
    print(f"{file}: valid; {len(names)} source{'' if len(names) == 1 else 's'}: {', '.join(names)}")


@app.command()
def show(config: ConfigOption = None, server: ServerOption = None) -> None:
    """Print the effective configuration and where each value comes from. Secrets are masked."""
    from gateway.cli.configuration import configuration_from_options
    from gateway.config.show import shown_configuration

    print(shown_configuration(configuration_from_options(config, server)), end="")


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors; same as config/gateway.schema.json."""
    from gateway.config.schema import schema_text
    from gateway.outputs.registry import settings_type

    print(schema_text(settings_type()), end="")
