"""docs/reference/commands.md agrees with the help texts of every command and option."""

import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path

import pytest
import typer.core
from typer.core import TyperCommand

from gateway.tools.cli.main import EXIT_STATUSES, app

REFERENCE = (Path(__file__).parents[4] / "docs/reference/commands.md").read_text(encoding="utf-8")


def commands(command: object = None, name: str = "rtc3d-gateway") -> Iterator[tuple[str, TyperCommand]]:
    """Yield every command that is not a group, with its full name."""
    command = typer.main.get_command(app) if command is None else command
    if isinstance(command, typer.core.TyperGroup):
        context = typer.Context(command)
        for subcommand_name in command.list_commands(context):
            subcommand = command.get_command(context, subcommand_name)
            yield from commands(subcommand, f"{name} {subcommand_name}")
    else:
        assert isinstance(command, TyperCommand)
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
    names = parameter.opts if is_option else [(parameter.metavar or parameter.opts[0]).upper()]
    return f"| {', '.join(f'`{name}`' for name in names)} | {shown} | {parameter.help} |"


def table(command: TyperCommand) -> str:
    """Return the table of a command's arguments and options."""
    rows = [row(parameter) for parameter in command.params if parameter.name != "context"]
    return "\n".join(["| option | default | what |", "|---|---|---|", *rows]) + "\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_reference_has_all_options_of_a_command(name: str) -> None:
    command = COMMANDS[name]
    part = REFERENCE.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
    expected = table(command) if command.params else "It has no options.\n"
    assert expected in part, f"put this below ## {name}:\n{expected}"


def test_reference_has_exactly_the_commands_of_the_program() -> None:
    assert set(re.findall(r"^## (rtc3d-gateway .*)$", REFERENCE, re.MULTILINE)) == COMMANDS.keys()


def test_reference_has_every_exit_status() -> None:
    documented = set(re.findall(r"^\| (\d) \| ", REFERENCE, re.MULTILINE))
    assert documented == {"0", "1", "2"} | {str(status) for status in EXIT_STATUSES.values()}
