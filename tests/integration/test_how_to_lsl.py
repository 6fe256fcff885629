"""Type every command of docs/how-to/lsl.md, and compare the output with the page."""

from pathlib import Path

import pytest

from tests.terminals import Terminal, folder, follow, terminals

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    assert follow("docs/how-to/lsl.md", folder, terminals) == 3
