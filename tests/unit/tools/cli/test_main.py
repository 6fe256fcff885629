"""The table of commands: what is imported for which command line, names, aliases."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateway.tools.cli.main import ALIASES, COMMANDS, app
from tests.support.errors import names
from tests.unit.tools.cli.test_commands_reference import COMMANDS as ALL_COMMANDS

DEMO = Path(__file__).parents[4] / "config/demo.yaml"
SLOW = (
    *("cysystemd", "ezc3d", "foxglove", "lcm", "lxml", "numpy", "prometheus_client", "rtc3d"),
    *("textual", "uvloop", "viser", "zenoh"),
)
"""What commands need to do their work, but not to print their help. Typer itself needs pydantic."""

PROGRAM = """
import sys
from typer.testing import CliRunner
from gateway.tools.cli.main import app
for words in sys.stdin.read().splitlines():
    assert CliRunner().invoke(app, words.split()).exit_code == 0
    print(words, *sorted({name.partition(".")[0] for name in sys.modules}))
"""


def imported_by(*command_lines: str) -> list[set[str]]:
    """Run command lines in one process; return which packages have been imported after each of them."""
    command = (sys.executable, "-c", PROGRAM)
    run = subprocess.run(command, input="\n".join(command_lines), capture_output=True, text=True, check=True)
    return [set(line.split()) for line in run.stdout.splitlines()]


def test_version_and_help_import_nothing_slow() -> None:
    for packages in imported_by("--version", "--help", "-h"):
        assert packages & {*SLOW, "asyncio", "pydantic"} == set()


def test_help_of_a_command_imports_nothing_slow() -> None:
    helps = [f"{name.removeprefix('rtc3d-gateway ')} --help" for name in ALL_COMMANDS]
    for command_line, packages in zip(helps, imported_by(*helps), strict=True):
        assert packages & {*SLOW} == set(), command_line


@pytest.mark.parametrize("target", [*COMMANDS.values(), *ALIASES.values()])
def test_every_entry_of_the_table_exists(target: str) -> None:
    module, _, attribute = target.partition(":")
    assert hasattr(import_module(module), attribute)


@pytest.mark.parametrize("name", ["", *ALL_COMMANDS, "take", "config"])
def test_h_is_help(name: str) -> None:
    words = name.removeprefix("rtc3d-gateway").split()
    shown = CliRunner().invoke(app, [*words, "-h"])
    assert shown.exit_code == 0
    assert shown.output == CliRunner().invoke(app, [*words, "--help"]).output
    assert "Usage:" in shown.output


def test_check_is_config_check() -> None:
    shown = CliRunner().invoke(app, ["check", str(DEMO)])
    assert (shown.exit_code, shown.output) == (0, f"{DEMO}: valid; 1 source: lab\n")
    assert shown.output == CliRunner().invoke(app, ["config", "check", str(DEMO)]).output
    assert "\u2502 check " not in CliRunner().invoke(app, ["--help"]).output


def test_a_misspelt_command_is_status_2_with_a_hint() -> None:
    shown = CliRunner().invoke(app, ["docter"])
    assert shown.exit_code == 2
    assert names(shown.output, "'docter'", "'doctor'")
