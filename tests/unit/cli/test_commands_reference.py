"""docs/reference/commands.md says of every command and option what the program says of it."""

import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path

import pytest
import typer.core

from gateway.cli.main import app
from gateway.cli.params import EXIT_STATUSES

REFERENCE = (Path(__file__).parents[3] / "docs/reference/commands.md").read_text(encoding="utf-8")


def commands(
    command: object = None, name: str = "rtc3d-gateway"
) -> Iterator[tuple[str, typer.core.TyperCommand]]:
    """Yield the commands that can be run, each with its whole name."""
    command = typer.main.get_command(app) if command is None else command
    if isinstance(command, typer.core.TyperGroup):
        for subcommand_name, subcommand in command.commands.items():
            yield from commands(subcommand, f"{name} {subcommand_name}")
    else:
        assert isinstance(command, typer.core.TyperCommand)
        yield name, command


COMMANDS = dict(commands())


def row(parameter: object) -> str:
    assert isinstance(parameter, typer.core.TyperOption | typer.core.TyperArgument)
    default = parameter.default
    if default is None or isinstance(default, bool):
        shown = ""
    else:
        value = default.value if isinstance(default, Enum) else default
        shown = f"`{value:g}`" if isinstance(value, float) else f"`{value}`"
    is_option = isinstance(parameter, typer.core.TyperOption)
    name = parameter.opts[0] if is_option else (parameter.metavar or parameter.opts[0]).upper()
    return f"| `{name}` | {shown} | {parameter.help} |"


def table(command: typer.core.TyperCommand) -> str:
    """Return the table of a command's arguments and options."""
    rows = [row(parameter) for parameter in command.params if parameter.name != "context"]
    return "\n".join(["| option | default | what |", "|---|---|---|", *rows]) + "\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_told_with_all_its_options(name: str) -> None:
    command = COMMANDS[name]
    part = REFERENCE.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
    expected = table(command) if command.params else "It has no options.\n"
    assert expected in part, f"put this below ## {name}:\n{expected}"


def test_every_command_that_is_told_is_there() -> None:
    assert set(re.findall(r"^## (rtc3d-gateway .*)$", REFERENCE, re.MULTILINE)) == COMMANDS.keys()


def test_every_exit_status_is_told() -> None:
    told = set(re.findall(r"^\| (\d) \| ", REFERENCE, re.MULTILINE))
    assert told == {"0", "1", "2"} | {str(status) for status in EXIT_STATUSES.values()}
