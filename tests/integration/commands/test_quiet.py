"""``--quiet`` of the commands that show their progress on a terminal."""

import os
import pty
import subprocess
from pathlib import Path
from typing import Final

import pytest

from tests.support.gateway_process import PROGRAM
from tests.support.takes import description, markers, write_take

HIDDEN_CURSOR: Final = b"\x1b[?25l"
"""What a line of progress begins with."""


def written_to_the_terminal(folder: Path, *arguments: str) -> bytes:
    """Run the program with a terminal as stderr, and return what it writes there."""
    terminal, child = pty.openpty()
    environ = {**os.environ, "TERM": "xterm"}
    with subprocess.Popen(
        (*PROGRAM, *arguments), cwd=folder, env=environ, stdin=-3, stdout=-3, stderr=child
    ) as process:
        os.close(child)
        written = b""
        try:
            while data := os.read(terminal, 65536):
                written += data
        except OSError:  # the program has closed the terminal
            pass
        os.close(terminal)
    assert process.returncode in {0, 1}, written
    return written


@pytest.mark.netns
@pytest.mark.parametrize(
    "arguments",
    [
        ("record", "new.lcmlog", "--seconds", "0.3", "--lcm"),
        ("replay", "take.lcmlog", "--zenoh", "--rate", "max"),
        ("export", "take.lcmlog", "take.csv"),
        ("take", "info", "take.lcmlog"),
    ],
)
def test_quiet_commands_show_no_progress(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    write_take(tmp_path / "take.lcmlog", [description(), *(markers(3, sequence) for sequence in range(10))])
    assert HIDDEN_CURSOR not in written_to_the_terminal(tmp_path, *arguments, "--quiet")
    for file in tmp_path.glob("take*.csv"):
        file.unlink()
    assert HIDDEN_CURSOR in written_to_the_terminal(tmp_path, *arguments)
