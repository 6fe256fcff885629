"""``rtc3d-gateway config``: check or show a configuration, or print the JSON schema."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.options import ConfigOption, ServerOption
from gateway.config.files import DEFAULT_CONFIG

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
) -> None:
    """Check a configuration file and print every mistake with its line. Starts nothing."""
    from gateway.cli.configuration import chosen_file
    from gateway.config.loading import read
    from gateway.outputs.registry import settings_type

    if file is not None and config is not None:
        raise typer.BadParameter("give the file once, as FILE or as --config FILE")
    path = chosen_file(file or config, None, wanted="FILE")
    names = [source.name for source in read(path, settings_type()).settings.sources]
    if not quiet:
        sources = f"{len(names)} source{'' if len(names) == 1 else 's'}: {', '.join(names)}"
        print(f"{path or 'environment'}: valid; {sources}")


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
