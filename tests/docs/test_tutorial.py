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


@pytest.mark.parametrize(
    ("page", "printed", "is_same"),
    [
        ("walk: 8.4 s, 6.4 MB", "walk: 1.2 s, 958.2 kB", True),
        ("walk: 8.4 s, 6.4 MB", "walk: 1 h 2 min 3.4 s, 12 bytes", True),
        ("walk: 8.4 s, 6.4 MB", "walk: 1.2 s, 958.2 kHz", False),
        ("walk: 8.4 s, 6.4 MB", "walk: 1.2 ms, 958.2 kB", False),
        ("806 messages at -0.5 Hz", "1,234,567 messages at 12 Hz", True),
        ("4 s", "4 sources", False),
    ],
)
def test_units_of_size_and_time_depend_on_the_number(page: str, printed: str, is_same: bool) -> None:
    terminal = Terminal(Path())
    terminal.text = printed + "\n"
    assert terminal.shows([page]) is is_same
