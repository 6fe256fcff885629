"""``rtc3d-gateway check``: check a configuration file."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.config.loading import read
from gateway.outputs.registry import settings_type


def check(file: Annotated[Path, typer.Argument(help="The configuration file to check.")]) -> None:
    """Check a configuration file and print every mistake with its line. Starts nothing."""
    names = [source.name for source in read(file, settings_type()).settings.sources]
    print(f"{file}: valid; {len(names)} source{'' if len(names) == 1 else 's'}: {', '.join(names)}")
