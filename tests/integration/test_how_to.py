"""Type the commands of each how-to that can be tried without a server, and compare the output."""

from pathlib import Path
from typing import Final

import pytest

from tests.documents import ROOT
from tests.terminals import Terminal, folder, follow, terminals

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]

SECTION: Final = "\n## Try it without any server\n"
PAGES: Final = sorted(
    path.stem for path in (ROOT / "docs/how-to").glob("*.md") if SECTION in path.read_text(encoding="utf-8")
)


def test_pages_can_be_tried() -> None:
    """Other tests run the commands of the pages record, use-takes, secure and service."""
    servers = {"first-principles", "wavefront", "several-servers"}
    assert servers | {"router", "lcm", "ros2", "replay", "troubleshoot"} <= set(PAGES)


@pytest.mark.parametrize("page", PAGES)
def test_every_command_prints_the_output_on_the_page(
    page: str, folder: Path, terminals: dict[str, Terminal]
) -> None:
    assert follow(f"docs/how-to/{page}.md", folder, terminals) > 2
