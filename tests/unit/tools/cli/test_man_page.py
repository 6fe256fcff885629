"""The man page has every command, option and exit status, and is troff without mistakes."""

import re
import shutil
import subprocess
import sys

import typer

from gateway.tools.cli.main import EXIT_STATUSES, app
from gateway.tools.cli.man_page import man_page
from tests.unit.tools.cli.test_commands_reference import COMMANDS

PAGE = man_page()


def plain(troff: str) -> str:
    """Return what a reader sees of some lines."""
    characters = re.sub(r"\\\[u(\w{4})\]", lambda found: chr(int(found[1], 16)), troff)
    return re.sub(r"\\f[BIR]|\\&|\\(?=[-e])", "", characters)


def parts() -> dict[str, str]:
    """Return what a reader sees of each command."""
    found = re.findall(r"^\.SS ([^\n]*)\n(.*?)(?=^\.S[SH])", PAGE, re.MULTILINE | re.DOTALL)
    return {plain(title).partition(" [")[0]: plain(title + "\n" + text) for title, text in found}


def test_every_command_is_described_with_its_options() -> None:
    described = parts()
    assert list(described) == [name.removeprefix("rtc3d-gateway ") for name in COMMANDS]
    for name, text in zip(COMMANDS, described.values(), strict=True):
        command = COMMANDS[name]
        assert command.help is not None
        assert " ".join(command.help.split()) in " ".join(text.replace(".PP", "").split())
        for parameter in command.params:
            for option in parameter.opts:
                assert not option.startswith("-") or re.search(rf"^.*{option}\b", text, re.MULTILINE), option
            assert str(getattr(parameter, "help", "")) in text, parameter.name


def test_options_of_the_program_and_exit_statuses_are_described() -> None:
    group = typer.main.get_command(app)
    head = plain(PAGE.partition(".SH COMMANDS")[0])
    for parameter in group.params:
        assert f"\n{parameter.opts[0]}\n" in head
    statuses = re.findall(r"^\\fB(\d+)\\fR$", PAGE.partition(".SH EXIT STATUS")[2], re.MULTILINE)
    assert {int(status) for status in statuses} == {0, 1, 2, *EXIT_STATUSES.values(), 130}


def test_only_known_requests_begin_a_line() -> None:
    requests = {line.split()[0] for line in PAGE.splitlines() if line.startswith((".", "'"))}
    assert requests == {".TH", ".SH", ".SS", ".TP", ".PP"}
    assert PAGE.isascii()
    if groff := shutil.which("groff"):
        read = subprocess.run(
            (groff, "-man", "-ww", "-z"), input=PAGE, capture_output=True, text=True, check=True
        )
        assert read.stderr == ""


def test_the_module_prints_the_page() -> None:
    command = (sys.executable, "-m", "gateway.tools.cli.man_page")
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == PAGE
