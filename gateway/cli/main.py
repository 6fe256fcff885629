"""The command line ``rtc3d-gateway``.

Exit status: 0 success, 1 failure, 2 wrong command line or configuration; ``params`` has three more.
"""

import os
import sys
import traceback
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
from gateway.service.process_end import end_process

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
    """Run the command line and end the process."""
    end_process(_run_command())


def _run_command() -> int:
    """Return the exit status. Errors of the gateway are printed to stderr without a traceback."""
    try:
        app()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except ConfigError as error:
        return _print_error(error, 2)
    except GatewayError as error:
        return _print_error(error, 1)
    except BrokenPipeError:
        # The reader of stdout is gone (… | head). Without this, flushing it fails again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except BaseException:  # noqa: BLE001 - a defect
        traceback.print_exc()
        return 1
    return 0


def _print_error(error: GatewayError, status: int) -> int:
    print(safe_lines(str(error)), file=sys.stderr)
    return status


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
