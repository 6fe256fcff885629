"""``rtc3d-gateway config``: show the effective configuration, or the JSON schema."""

import typer

from gateway.cli.options import ConfigOption, ServerOption, configuration_from_options
from gateway.config.schema import schema_text
from gateway.config.show import shown_configuration
from gateway.outputs.registry import settings_type

app = typer.Typer(no_args_is_help=True, help="Show the effective configuration, or the JSON schema.")


@app.command()
def show(config: ConfigOption = None, server: ServerOption = None) -> None:
    """Print the effective configuration and where each value comes from. Secrets are masked."""
    print(shown_configuration(configuration_from_options(config, server)), end="")


@app.command()
def schema() -> None:
    """Print the JSON schema of configuration files, for editors; same as config/gateway.schema.json."""
    print(schema_text(settings_type()), end="")
