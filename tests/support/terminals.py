"""Terminals in which tests type the commands of a page and compare the output with it."""

import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.support.documents import ROOT, Block, blocks

LONG_RUNNING: Final = (
    "rtc3d-gateway simulate",
    "rtc3d-gateway run",
    "rtc3d-gateway view",
    "rtc3d-gateway replay examples/walk.lcmlog --loop",
    "python router.py",
)
"""Commands that run until Ctrl-C."""

LISTS: Final = (
    "rtc3d-gateway list",
    "rtc3d-gateway params",
    "rtc3d-gateway take list",
    "rtc3d-gateway export",
)
"""Commands that print another text where there is no terminal; the pages show that of a terminal."""

TIMEOUT_S: Final = 120

_NUMBER: Final = r"(?:-?\d+(?:,\d{3})*(?:\.\d+)?|\bnan\b)"
_SIZE: Final = rf"{_NUMBER}\s+(?:bytes|[kMG]B)\b"
_DURATION: Final = rf"(?:\d+\s+h\s+)?(?:\d+\s+min\s+)?{_NUMBER}\s+s\b"
_VARIABLE: Final = {"size": _SIZE, "duration": _DURATION, "number": _NUMBER}
"""What differs from run to run. The unit of a size or a duration depends on how large it is."""

_PARTS: Final = re.compile(
    "|".join(f"(?P<{kind}>{expression})" for kind, expression in _VARIABLE.items())
    + r"|(?P<any>…)|(?P<space>\s+)|(?P<text>[^\s…\d-]+|-)"
)


def pattern(line: str) -> str:
    """Return a pattern that matches a line with other sizes, durations, numbers, and any text for ``…``."""
    kinds = _VARIABLE | {"any": ".*", "space": r"\s+"}
    return "".join(
        kinds.get(part.lastgroup or "", re.escape(part[0])) for part in _PARTS.finditer(line.strip())
    )


class Terminal:
    """A terminal that runs one command at a time. ``text`` is the output of the command so far."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._environ = {"PYTHONUNBUFFERED": "1", "BROWSER": "true", "XDG_STATE_HOME": str(folder / "state")}
        self._process: subprocess.Popen[bytes] | None = None
        self.text = ""

    def type(self, command: str) -> None:
        """Start a command in the activated virtual environment."""
        assert self._process is None, "the previous command is still running"
        self.text = ""
        is_list = {"TTY_COMPATIBLE": "1", "TERM": "dumb"} if command.startswith(LISTS) else {}
        self._process = subprocess.Popen(
            ["bash", "-c", f"source .venv/bin/activate && exec {command}"],
            cwd=self._folder,
            env=os.environ | self._environ | is_list,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def shows(self, lines: list[str]) -> bool:
        """Return whether the output contains these lines in this order."""
        patterns = [pattern(line) for line in lines if line != "…"]
        return re.search(r"\s*?\n(?:.*\n)*?\s*".join(patterns), self.text) is not None

    def wait_for(self, lines: list[str]) -> None:
        """Read until the output contains these lines; raises AssertionError after TIMEOUT_S."""
        assert self._process is not None
        assert self._process.stdout is not None
        deadline_s = time.monotonic() + TIMEOUT_S
        while not self.shows(lines):
            assert select.select([self._process.stdout], [], [], deadline_s - time.monotonic())[0], self.text
            data = os.read(self._process.stdout.fileno(), 65536)
            assert data, f"ended without {lines}:\n{self.text}"
            self.text += data.decode()

    def end(self, number: signal.Signals | None = None) -> int:
        """Wait for the end of the command, after signal ``number`` if given; return its exit status."""
        assert self._process is not None
        process, self._process = self._process, None
        if number is not None:
            process.send_signal(number)
        try:
            rest, _ = process.communicate(timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            raise
        self.text += rest.decode()
        return process.returncode

    @property
    def is_busy(self) -> bool:
        return self._process is not None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that looks like the repository after ``make demo`` has installed the gateway."""
    for path in ROOT.iterdir():
        if not path.name.startswith("."):
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv/bin").symlink_to(Path(sys.executable).parent)
    (tmp_path / ".venv/runtime").touch()
    (tmp_path / ".venv/installed").touch()
    return tmp_path


@pytest.fixture
def terminals(folder: Path) -> Iterator[dict[str, Terminal]]:
    terminals = {f"terminal {number}": Terminal(folder) for number in range(1, 6)}
    yield terminals
    for terminal in terminals.values():
        if terminal.is_busy:
            terminal.end(signal.SIGKILL)


def output_after(steps: list[Block], step: int) -> list[str]:
    """Return the output that the page shows after a command; [] if it shows none."""
    next_blocks = steps[step + 1 : step + 2]
    is_output = next_blocks and next_blocks[0].language == "text"
    return next_blocks[0].text.splitlines() if is_output else []


def follow(document: str, folder: Path, terminals: dict[str, Terminal]) -> int:
    """Do what a page says, compare the output of each command, and return how many commands there were.

    Blocks with a title are files to write, or commands to type in a terminal. A command that runs until
    Ctrl-C ends when the next one is typed in its terminal, or at the end of the page.
    """
    steps = blocks(document)
    num_commands = 0
    for step, block in enumerate(steps):
        if block.language in {"yaml", "python", "toml"} and block.title:
            file = folder / block.title
            assert not file.is_symlink(), f"{block.place} would overwrite a file of the repository"
            file.parent.mkdir(exist_ok=True)
            file.write_text(block.text)
        elif block.language == "sh" and block.title:
            command = block.text.strip()
            assert "\n" not in command, "a block must hold one command, because its output follows"
            terminal = terminals[block.title]
            if terminal.is_busy:
                assert terminal.end(signal.SIGINT) == 0, terminal.text
            terminal.type(command)
            num_commands += 1
            output = output_after(steps, step)
            if command.startswith(LONG_RUNNING):
                terminal.wait_for(output)
            else:
                status = 1 if any(line.startswith("  FAIL ") for line in output) else 0
                assert terminal.end() == status, f"{block.place}:\n{terminal.text}"
                assert terminal.shows(output), f"{block.place} printed:\n{terminal.text}"
    for terminal in reversed(terminals.values()):
        if terminal.is_busy:
            assert terminal.end(signal.SIGINT) == 0, terminal.text
    return num_commands
