"""Ctrl-C while a command is still starting: it ends quietly, whatever it has imported so far."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

from gateway.cli.main import COMMANDS

INTERRUPT: Final = """
import os, sys, _signal

num_left = None

def count(event, arguments):
    global num_left
    if event == "import" and num_left is not None:
        num_left -= 1
        if num_left == 0:
            _signal.raise_signal(_signal.SIGINT)
    elif event == "import" and arguments[0] == "gateway":  # the first line of the package comes next
        num_left = int(os.environ["INTERRUPTED_IMPORT"])

sys.addaudithook(count)
"""


def test_a_command_that_is_interrupted_while_it_starts_ends_quietly(tmp_path: Path) -> None:
    """From the first import on that the program makes; Python itself ends with a traceback before.

    The first imports are the same for all commands, so one command stands for the others there.
    """
    (tmp_path / "sitecustomize.py").write_text(INTERRUPT)
    program = "import sys; from gateway.__main__ import main; sys.exit(main())"  # as the installed script
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, command, "--help"],
            env={**os.environ, "PYTHONPATH": str(tmp_path), "INTERRUPTED_IMPORT": str(number)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command, number in [
            *(("run", number) for number in (1, 2, 5, 40)),
            *((command, 200) for command in COMMANDS),
        ]
    ]
    found = [(*process.communicate(), process.returncode) for process in processes]
    assert found == [("", "", 130)] * len(processes)
