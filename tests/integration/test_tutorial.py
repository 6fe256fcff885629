"""Run every command of the tutorial in its terminal, in order, and compare the output with the page."""

from pathlib import Path

import pytest

from tests.terminals import LONG_RUNNING, Terminal, folder, follow, terminals

pytestmark = pytest.mark.netns

__all__ = ["LONG_RUNNING", "Terminal", "folder", "terminals"]


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    assert follow("docs/tutorial.md", folder, terminals) > 8


def test_lines_match_if_only_their_numbers_differ() -> None:
    terminal = Terminal(Path())
    terminal.text = "frame 12: 23 of 24 markers in view\nframe 13: 24 of 24 markers in view\n"
    assert terminal.shows(["frame 1: 2 of 3 markers in view", "…"])
    assert not terminal.shows(["frame 1: 2 of 3 tools in view"])
    assert not terminal.shows(["frame 1: 2 of 3 markers in view"] * 3)
