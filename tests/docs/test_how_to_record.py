"""Type every command of docs/how-to/record.md, and compare the output with the page."""

from pathlib import Path

import pytest

from gateway.takes.reader import TakeReader
from tests.terminals import Terminal, folder, follow, terminals

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    assert follow("docs/how-to/record.md", folder, terminals) > 3
    keys = {message.key for message in TakeReader(folder / "walk.lcmlog").messages()}
    assert {"take", "parameters", "3d", "6d", "analog", "force", "event", "status", "clock"} <= keys
