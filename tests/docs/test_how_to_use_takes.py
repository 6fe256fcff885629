"""Type every command of docs/how-to/use-takes.md, and compare the output with the page."""

from pathlib import Path

import pytest

from tests.terminals import Terminal, folder, follow, terminals
from tests.unit.export.exported import read_ezc3d
from tests.unit.export.read_mcap import read_mcap
from tests.unit.export.test_trc import read_trc

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    assert follow("docs/how-to/use-takes.md", folder, terminals) > 6
    assert read_ezc3d(folder / "walk.c3d")["data"]["points"].shape[1] == 34
    assert len(read_trc(folder / "walk.trc").labels) == 34
    assert {"/lab/markers", "/lab/tools", "/lab/forces"} < read_mcap(folder / "walk.mcap").topics.keys()
    components = sorted(path.name for path in folder.glob("walk-*.csv"))
    assert components == [f"walk-{key}.csv" for key in ("3d", "6d", "analog", "event", "force")]
