"""Ctrl-C while a command is still starting: it ends quietly, whatever it has imported so far."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import pytest

from gateway.tools.cli.main import COMMANDS

INTERRUPT: Final = """
import os, sys, _signal

interrupted, is_own = os.environ["INTERRUPTED_IMPORT"], bool(os.environ["COUNT_OWN_IMPORTS"])
num_imports = first_handler = None

def count(event, arguments):
    global num_imports, first_handler
    if event != "import":
        return
    handler = _signal.getsignal(_signal.SIGINT)
    if arguments[0] == "gateway" and num_imports is None:  # the first line of the package comes next
        num_imports = 0
        return
    if arguments[0] == "gateway.tools.cli.main" and first_handler is None:
        first_handler = handler
    if num_imports is None or is_own and (first_handler is None or handler is first_handler):
        return
    num_imports += 1
    if interrupted in (arguments[0], str(num_imports)):
        _signal.raise_signal(_signal.SIGINT)

sys.addaudithook(count)
"""

ARGUMENTS: Final = {
    "replay": ["missing.lcmlog"],
    "export": ["missing.lcmlog", "missing.csv"],
    "take": ["info", "missing.lcmlog"],
    "config": ["show"],
}
"""What the commands need to get to their own imports."""


@pytest.fixture(name="directory")
def _directory(tmp_path: Path) -> Path:
    (tmp_path / "sitecustomize.py").write_text(INTERRUPT)
    return tmp_path


def _start(directory: Path, command: str, arguments: list[str], number: str, *, is_own: bool) -> Any:
    """Start a command that is interrupted at an import, by its number or its name.

    The number counts all imports, or those after the command has its own handler of Ctrl-C.
    """
    program = "import sys; from gateway.__main__ import main; sys.exit(main())"  # as the installed script
    return subprocess.Popen(
        [sys.executable, "-c", program, command, *arguments],
        env={
            **os.environ,
            "PYTHONPATH": str(directory),
            "INTERRUPTED_IMPORT": number,
            "COUNT_OWN_IMPORTS": "1" if is_own else "",
        },
        cwd=directory,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_command_that_is_interrupted_while_it_starts_ends_quietly(directory: Path) -> None:
    """From the first import on that the program makes; Python itself ends with a traceback before.

    The first imports are the same for all commands, so one command stands for the others there.
    """
    processes = [
        _start(directory, "run", ["--help"], str(number), is_own=False) for number in (1, 2, 5, 40, 200)
    ]
    found = [(*process.communicate(), process.returncode) for process in processes]
    assert found == [("", "", 130)] * len(processes)


def test_a_command_that_is_interrupted_in_its_own_imports_ends_quietly(directory: Path) -> None:
    """Its function makes them, when Ctrl-C already raises KeyboardInterrupt; ``run`` ends with success."""
    processes = {
        command: _start(directory, command, ARGUMENTS.get(command, []), "1", is_own=True)
        for command in COMMANDS
    }
    found = {command: (*process.communicate(), process.returncode) for command, process in processes.items()}
    assert found == {command: ("", "", 0 if command == "run" else 130) for command in COMMANDS}


def test_an_interrupt_while_python_imports_unicodedata_is_no_syntax_error(
    directory: Path,
) -> None:
    """Compiling a module with a named character imports unicodedata, and hides what its import raises."""
    process = _start(directory, "take", ARGUMENTS["take"], "unicodedata", is_own=False)
    assert (*process.communicate(), process.returncode) == ("", "", 130)
