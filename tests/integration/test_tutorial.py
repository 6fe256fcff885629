"""Run every command of the tutorial in its terminal, in order, and compare the output with the page."""

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
LONG_RUNNING: Final = ("rtc3d-gateway simulate", "rtc3d-gateway run")
"""Commands that run until the end of the tutorial."""

TIMEOUT_S: Final = 60
NUMBER: Final = re.compile(r"-?\d+(?:\\\.\d+)?")


def pattern(line: str) -> str:
    """Return a pattern that matches a line with other numbers, other white space, and any text for ``…``."""
    escaped = re.escape(" ".join(line.split())).replace(r"\ ", r"\s+").replace(re.escape("…"), ".*")
    return NUMBER.sub(r"-?\\d+(?:\\.\\d+)?", escaped.replace(r"\-", "-"))


class Terminal:
    """A terminal that runs one command at a time. ``text`` is the output of the command so far."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self.text = ""

    def type(self, command: str) -> None:
        """Start a command in the activated virtual environment."""
        assert self._process is None, "the previous command is still running"
        self.text = ""
        self._process = subprocess.Popen(
            ["bash", "-c", f"source .venv/bin/activate && exec {command}"],
            cwd=self._folder,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
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
    terminals = {name: Terminal(folder) for name in ("terminal 1", "terminal 2", "terminal 3")}
    yield terminals
    for terminal in terminals.values():
        if terminal.is_busy:
            terminal.end(signal.SIGKILL)


def output_after(step: int) -> list[str]:
    """Return the output that the page shows after a command; [] if it shows none."""
    next_blocks: list[Block] = STEPS[step + 1 : step + 2]
    is_output = next_blocks and next_blocks[0].language == "text"
    return next_blocks[0].text.splitlines() if is_output else []


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    commands = []
    for step, block in enumerate(STEPS):
        if block.language in {"yaml", "python"}:
            (folder / block.title).write_text(block.text)
        elif block.language == "sh" and block.title:
            command = block.text.strip()
            assert "\n" not in command, "a block must hold one command, because its output follows"
            terminal = terminals[block.title]
            terminal.type(command)
            commands.append(command)
            if command.startswith(LONG_RUNNING):
                terminal.wait_for(output_after(step))
            else:
                assert terminal.end() == 0, f"{block.place}:\n{terminal.text}"
                assert terminal.shows(output_after(step)), f"{block.place} printed:\n{terminal.text}"
    assert len(commands) > 8
    for name in ("terminal 2", "terminal 1"):
        assert terminals[name].end(signal.SIGINT) == 0, terminals[name].text


def test_lines_match_if_only_their_numbers_differ() -> None:
    terminal = Terminal(Path())
    terminal.text = "frame 12: 23 of 24 markers in view\nframe 13: 24 of 24 markers in view\n"
    assert terminal.shows(["frame 1: 2 of 3 markers in view", "…"])
    assert not terminal.shows(["frame 1: 2 of 3 tools in view"])
    assert not terminal.shows(["frame 1: 2 of 3 markers in view"] * 3)
