"""The command line ``rtc3d-gateway``.

Exit status: 0 success, 1 failure, 2 wrong command line or configuration, 130 Ctrl-C or SIGTERM.
Commands that ask gateways have three more.
"""

import contextlib
import errno
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable
from types import FrameType
from typing import Annotated, Any, Final, NoReturn

import typer

from gateway import version_text
from gateway.cli.commands import LazyGroup
from gateway.cli.completion import is_completion
from gateway.errors import ConfigError, GatewayError, SelectionError
from gateway.safe_text import safe_lines
from gateway.service.process_end import end_process

_OUTPUT_ERRORS: Final = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF}
"""Numbers of errors that writing to stdout raises, for example on a full disk."""

app = typer.Typer(
    name="rtc3d-gateway",
    cls=LazyGroup,
    help="Publish data of RTC3D motion-capture servers (NDI First Principles, WaveFront) on Zenoh and LCM.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def main() -> NoReturn:
    """Run the command line and end the process, whatever happens, without a traceback.

    Ctrl-C and SIGTERM give status 130. It is no failure if the reader of stdout is gone (… | head).
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for locales other than UTF-8
    try:
        status = _run()
    except KeyboardInterrupt:
        status = 130
    _handle_interrupts(lambda *_: os._exit(status))
    end_process(status)


def _handle_interrupts(handler: Callable[[int, FrameType | None], Any]) -> None:
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # ignored by nohup, and by shells for `&`
        signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)  # its default action would leave unfinished files behind


def _run() -> int:
    """Run the command, and return the exit status. Errors are printed to stderr."""
    stdout = sys.stdout
    try:
        app(prog_name="rtc3d-gateway", obj=lambda: _handle_interrupts(signal.default_int_handler))
    except SystemExit as end:
        if sys.stdout is not stdout:  # typer replaces it if its reader is gone
            return 0
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except (ConfigError, SelectionError) as error:
        _print_error(str(error))
        return 2
    except GatewayError as error:
        _print_error(str(error))
    except BrokenPipeError:
        return 0
    except OSError as error:
        _print_os_error(error)
    except Exception as error:  # noqa: BLE001 - a traceback tells the user nothing
        last = traceback.extract_tb(error.__traceback__)[-1]
        _print_error(
            f"defect in rtc3d-gateway: {type(error).__name__}: {error} ({last.filename}:{last.lineno}); "
            "report this with the command and its options"
        )
    return 1


def _print_os_error(error: OSError) -> None:
    what = "cannot write the output: " if error.errno in _OUTPUT_ERRORS and error.filename is None else ""
    _print_error(f"{what}{error.strerror or error}" + (f": {error.filename}" if error.filename else ""))


def _print_error(text: str) -> None:
    if is_completion():  # it would be in the middle of the command line
        return
    with contextlib.suppress(OSError):
        print(safe_lines(text), file=sys.stderr, flush=True)


def _print_version(context: typer.Context, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        print(f"rtc3d-gateway {version_text()}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Set what holds for all commands. The module of the command is imported before.

    Until here, a signal ends the process at once.
    """
    if context.obj is not None and context.invoked_subcommand != "run":  # which handles signals itself
        context.obj()
