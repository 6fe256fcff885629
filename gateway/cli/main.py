"""The command line ``rtc3d-gateway``.

Exit status: 0 success, 1 failure, 2 wrong command line or configuration; ``params`` has three more.
"""

import os
import sys
from typing import Annotated, NoReturn

import typer

from gateway import version_text
from gateway.cli import config
from gateway.cli.check import check
from gateway.cli.demo import demo
from gateway.cli.doctor import doctor
from gateway.cli.echo import echo
from gateway.cli.params import params
from gateway.cli.run import run
from gateway.cli.simulate import simulate
from gateway.errors import ConfigError, GatewayError
from gateway.safe_text import safe_lines

app = typer.Typer(
    name="rtc3d-gateway",
    help="Publish data of RTC3D motion-capture servers (NDI First Principles, WaveFront) on Zenoh and LCM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (run, check, doctor, simulate, demo, echo, params):
    app.command()(command)
app.add_typer(config.app, name="config")


def main() -> NoReturn:
    """Run the command line. Errors of the gateway are printed to stderr without a traceback."""
    try:
        app()
    except ConfigError as error:
        _exit(str(error), 2)
    except GatewayError as error:
        _exit(str(error), 1)
    except BrokenPipeError:
        # The reader of stdout is gone (… | head). Without this, Python reports another error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(0)


def _exit(text: str, status: int) -> NoReturn:
    print(safe_lines(text), file=sys.stderr)
    sys.exit(status)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"rtc3d-gateway {version_text()}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    pass
