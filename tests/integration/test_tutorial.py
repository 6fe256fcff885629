"""The tutorial, typed as it stands, in order: each command in its terminal, with the output that it shows."""

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

from tests.documents import ROOT, Block, blocks

pytestmark = pytest.mark.netns

STEPS: Final = blocks("docs/tutorial.md")
STAYING: Final = ("rtc3d-gateway simulate", "rtc3d-gateway run")
"""Commands that end with the tutorial."""

PATIENCE_S: Final = 60
NUMBER: Final = re.compile(r"-?\d+(?:\\\.\d+)?")


def pattern(line: str) -> str:
    """Return what matches the printed line, whatever its numbers are; white space and ``…`` match any."""
    escaped = re.escape(" ".join(line.split())).replace(r"\ ", r"\s+").replace(re.escape("…"), ".*")
    return NUMBER.sub(r"-?\\d+(?:\\.\\d+)?", escaped.replace(r"\-", "-"))


class Terminal:
    """A shell's window, in which one command runs at a time; what it printed is in ``text``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self.text = ""

    def type(self, command: str) -> None:
        """Start a command, with the virtual environment that ``source .venv/bin/activate`` gives."""
        assert self._process is None, "the command before has not ended"
        self.text = ""
        self._process = subprocess.Popen(
            ["bash", "-c", f"source .venv/bin/activate && exec {command}"],
            cwd=self._folder,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def shows(self, lines: list[str]) -> bool:
        """Return whether these lines stand in what is printed, in this order."""
        patterns = [pattern(line) for line in lines if line != "…"]
        return re.search(r"\s*?\n(?:.*\n)*?\s*".join(patterns), self.text) is not None

    def wait_for(self, lines: list[str]) -> None:
        """Read on until these lines are shown; raises AssertionError if they are not in time."""
        assert self._process is not None
        assert self._process.stdout is not None
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.shows(lines):
            assert select.select([self._process.stdout], [], [], deadline_s - time.monotonic())[0], self.text
            some = os.read(self._process.stdout.fileno(), 65536)
            assert some, f"ended without {lines}:\n{self.text}"
            self.text += some.decode()

    def end(self, number: signal.Signals | None = None) -> int:
        """Wait for the command's end, which ``number`` may bring about; return its exit status."""
        assert self._process is not None
        process, self._process = self._process, None
        if number is not None:
            process.send_signal(number)
        try:
            rest, _ = process.communicate(timeout=PATIENCE_S)
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
    """A copy of the repository, as far as the tutorial goes, with what ``make`` has installed."""
    for path in ROOT.iterdir():
        if not path.name.startswith("."):
            (tmp_path / path.name).symlink_to(path)
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv/bin").symlink_to(Path(sys.executable).parent)
    (tmp_path / ".venv/installed").touch()
    return tmp_path


@pytest.fixture
def terminals(folder: Path) -> Iterator[dict[str, Terminal]]:
    made = {name: Terminal(folder) for name in ("terminal 1", "terminal 2", "terminal 3")}
    yield made
    for terminal in made.values():
        if terminal.is_busy:
            terminal.end(signal.SIGKILL)


def output_after(step: int) -> list[str]:
    """Return the lines that the page shows next, if it shows the command's output."""
    following: list[Block] = STEPS[step + 1 : step + 2]
    return following[0].text.splitlines() if following and following[0].language == "text" else []


def test_the_tutorial_as_it_stands(folder: Path, terminals: dict[str, Terminal]) -> None:
    typed = []
    for step, block in enumerate(STEPS):
        if block.language in {"yaml", "python"}:
            (folder / block.title).write_text(block.text)
        elif block.language == "sh" and block.title:
            command = block.text.strip()
            assert "\n" not in command, "one command a block: its output follows"
            terminal = terminals[block.title]
            terminal.type(command)
            typed.append(command)
            if command.startswith(STAYING):
                terminal.wait_for(output_after(step))
            else:
                assert terminal.end() == 0, f"{block.place}:\n{terminal.text}"
                assert terminal.shows(output_after(step)), f"{block.place} printed:\n{terminal.text}"
    assert len(typed) > 8
    for name in ("terminal 2", "terminal 1"):
        assert terminals[name].end(signal.SIGINT) == 0, terminals[name].text


def test_lines_that_differ_are_not_taken_for_the_same() -> None:
    terminal = Terminal(Path())
    terminal.text = "frame 12: 23 of 24 markers in view\nframe 13: 24 of 24 markers in view\n"
    assert terminal.shows(["frame 1: 2 of 3 markers in view", "…"])
    assert not terminal.shows(["frame 1: 2 of 3 tools in view"])
    assert not terminal.shows(["frame 1: 2 of 3 markers in view"] * 3)
