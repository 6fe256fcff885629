"""The command line in this process, for commands that end before they open or start anything.

Starting a program takes half a second, which adds up in tests with many cases.
"""

import contextlib
import io
import sys
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

from gateway.cli import main


class Ended(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run_in_process(*arguments: str | Path) -> Ended:
    """Run ``rtc3d-gateway`` with these arguments; it prints errors as the program does."""
    stdout, stderr = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["rtc3d-gateway", *map(str, arguments)]),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
    ):
        status = main._run()
    return Ended(status, stdout.getvalue(), stderr.getvalue())
