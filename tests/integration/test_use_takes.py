"""Type every command of docs/how-to/use-takes.md, and compare the output with the page."""

import signal
from pathlib import Path

import pytest

from tests.documents import blocks
from tests.integration.test_tutorial import LONG_RUNNING, Terminal, folder, terminals
from tests.unit.export.exported import read_ezc3d
from tests.unit.export.test_trc import read_trc

pytestmark = pytest.mark.netns

__all__ = ["folder", "terminals"]  # fixtures


def test_every_command_prints_the_output_on_the_page(folder: Path, terminals: dict[str, Terminal]) -> None:
    steps = blocks("docs/how-to/use-takes.md")
    num_commands = 0
    for step, block in enumerate(steps):
        following = steps[step + 1 : step + 2]
        output = following[0].text.splitlines() if following and following[0].language == "text" else []
        if block.language == "python":
            (folder / block.title).write_text(block.text)
        elif block.language == "sh" and block.title:
            terminal, command = terminals[block.title], block.text.strip()
            assert "\n" not in command
            terminal.type(command)
            num_commands += 1
            if command.startswith(LONG_RUNNING):
                terminal.wait_for(["RTC3D server" if "simulate" in command else "streaming"])
            else:
                status = terminal.end()
                # On a busy machine, some messages may be lost; that is not the matter of this page.
                assert status == 0 or command.startswith("rtc3d-gateway record"), (
                    f"{block.place}:\n{terminal.text}"
                )
                assert terminal.shows(output), f"{block.place} printed:\n{terminal.text}"
    assert num_commands > 6
    assert read_ezc3d(folder / "walk.c3d")["data"]["points"].shape[1] == 24
    assert len(read_trc(folder / "walk.trc").labels) == 24
    for name in ("terminal 2", "terminal 1"):
        assert terminals[name].end(signal.SIGINT) == 0, terminals[name].text
