"""The command line ``rtc3d-gateway``.

Exit status: 0 success, 1 failure, 2 wrong command line or configuration, 130 Ctrl-C or SIGTERM.
Commands that ask gateways have three more: EXIT_STATUSES.
"""

import contextlib
import errno
import io
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from types import FrameType
from typing import Annotated, Any, Final, NoReturn

import typer
import typer.core

from gateway import version_text
from gateway.errors import ConfigError, GatewayError, QueryError, SelectionError
from gateway.runtime.process_end import end_process
from gateway.runtime.safe_text import safe_json, safe_lines

COMMANDS: Final = {
    "run": "gateway.tools.cli.run:run",
    "doctor": "gateway.tools.cli.config:doctor",
    "simulate": "gateway.tools.cli.run:simulate",
    "demo": "gateway.tools.cli.run:demo",
    "list": "gateway.tools.cli.list_gateways:list_gateways",
    "view": "gateway.tools.cli.view:view",
    "echo": "gateway.tools.cli.echo:echo",
    "top": "gateway.tools.cli.top:top",
    "params": "gateway.tools.cli.params:params",
    "record": "gateway.tools.cli.record:record",
    "replay": "gateway.tools.cli.replay:replay",
    "export": "gateway.tools.cli.take:export",
    "take": "gateway.tools.cli.take:app",
    "config": "gateway.tools.cli.config:app",
}
"""Each command, in the order of ``--help``, with its function, or its ``typer.Typer`` if it has sub-commands.

Their modules must be quick to import: ``--help`` shows the first sentence of each function, and shells that
complete a line do not wait. So a function imports what it needs when it runs. A test checks this.
"""

COMPLETION_VARIABLE: Final = "_RTC3D_GATEWAY_COMPLETE"
"""The environment variable by which a shell asks for completions."""

ALIASES: Final = {"check": "gateway.tools.cli.config:check"}
"""Other names of commands, which are not listed: ``check`` is ``config check``."""


EXIT_STATUSES: Final = {"no-gateway": 3, "no-connection": 4, "timeout": 5}
"""Exit status by the code of the first problem with gateways; 1 for every other code."""


def exit_with(problems: Sequence[QueryError]) -> None:
    """Print problems, each once, and end with the status of the first one; without any, return."""
    for text in dict.fromkeys(str(problem) for problem in problems):
        print(safe_lines(text), file=sys.stderr)
    if problems:
        raise typer.Exit(EXIT_STATUSES.get(problems[0].code, 1))


def print_json(content: object) -> None:
    """Print a JSON object on several lines."""
    print(safe_json(json.dumps(content, indent=2, ensure_ascii=False)))


class LazyGroup(typer.core.TyperGroup):
    """The group of all commands, each imported when it is looked up."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = dict.fromkeys(COMMANDS)  # typer compares misspelt commands with these names

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002 - overrides
        """Return the names of the commands in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002 - overrides
        """Return a command by its name or its alias; None if there is none."""
        path = COMMANDS.get(cmd_name) or ALIASES.get(cmd_name)
        if path is None:
            return None
        module, _, attribute = path.partition(":")
        target = getattr(import_module(module), attribute)
        app = typer.Typer()
        if isinstance(target, typer.Typer):
            app.add_typer(target, name=cmd_name)
        else:
            app.command(cmd_name)(target)
        return typer.main.get_group(app).commands[cmd_name]


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
        is_output = error.errno in _OUTPUT_ERRORS and error.filename is None
        what = "cannot write the output: " if is_output else ""
        _print_error(f"{what}{error.strerror or error}" + (f": {error.filename}" if error.filename else ""))
    except Exception as error:  # noqa: BLE001 - a traceback tells the user nothing
        last = traceback.extract_tb(error.__traceback__)[-1]
        _print_error(
            f"defect in rtc3d-gateway: {type(error).__name__}: {error} ({last.filename}:{last.lineno}); "
            "report this with the command and its options"
        )
    return 1


def _print_error(text: str) -> None:
    if COMPLETION_VARIABLE in os.environ:  # it would be in the middle of the command line
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

    Until here, a signal ends the process at once. Python imports unicodedata when it compiles a module with a
    named character, and makes a SyntaxError of an interrupt there; so it is imported before.
    """
    import unicodedata  # noqa: F401

    if context.obj is not None and context.invoked_subcommand != "run":  # which handles signals itself
        context.obj()
