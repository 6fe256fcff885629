"""The tool that writes the help of commands into docs/reference/commands.md."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from tests.support.commands_page import update

SHARED_LINK = "[Shared options](#shared-options): "
PAGE = "# Commands\n\nAll.\n\n## Shared options\n\nOld.\n\n## gw send\n\nBy hand.\n\n## End\n\nThe end.\n"

Source = Annotated[str | None, typer.Option(help="Only this source.")]


class Speed(StrEnum):
    FAST = "fast"


def commands(**functions: Any) -> dict[str, Any]:
    """Return commands that run nothing, by their full names."""
    found = {}
    for name, function in functions.items():
        app = typer.Typer()
        app.command(name)(function)
        found[f"gw {name}"] = typer.main.get_command(app)
    return {name: without_completion(command) for name, command in found.items()}


def without_completion(command: Any) -> Any:
    command.params = [each for each in command.params if "completion" not in each.name]
    return command


def send(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What to send.")],
    *,
    rate: Annotated[float, typer.Option("--rate", "-r", metavar="HZ", help="Messages per second.")] = 2.5,
    speed: Annotated[Speed, typer.Option(help="How fast.")] = Speed.FAST,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing.")] = False,
    source: Source = None,
) -> None:
    """Send a file.

    Exit status 3: nobody listens.

    It can be sent again.
    """


def listen(
    *, quiet: Annotated[bool, typer.Option("--quiet", help="Log nothing.")], source: Source = None
) -> None:
    """Listen."""


def section(page: str, name: str) -> str:
    return page.partition(f"## {name}\n\n")[2].partition("\n## ")[0]


def test_a_section_begins_with_the_help_and_ends_with_what_people_wrote() -> None:
    page = update(PAGE, commands(send=send, listen=listen))
    assert section(page, "gw send") == (
        "Send a file.\n\nIt can be sent again.\n\n| option | what it does |\n|---|---|\n"
        "| `FILE` | What to send. |\n"
        "| `--rate HZ`, `-r` | Messages per second. The default is 2.5. |\n"
        "| `--speed SPEED` | How fast. The default is fast. |\n"
        "| `--quiet` | Print nothing. |\n\n"
        f"{SHARED_LINK}`--source`.\n\nBy hand.\n"
    )
    assert section(page, "End") == "The end.\n"


def test_an_option_with_the_same_help_in_several_commands_is_described_once() -> None:
    page = update(PAGE, commands(send=send, listen=listen))
    assert section(page, "Shared options") == (
        "| option | what it does |\n|---|---|\n| `--source SOURCE` | Only this source. |\n"
    )
    assert page.count("Only this source.") == 1
    assert "| `--quiet` | Log nothing. |" in section(page, "gw listen")


def test_a_page_that_is_up_to_date_stays_as_it_is() -> None:
    page = update(PAGE, commands(send=send, listen=listen))
    assert update(page, commands(send=send, listen=listen)) == page


def test_a_help_that_changes_replaces_the_former_one() -> None:
    def send(*, source: Source = None) -> None:
        """Send nothing."""

    page = update(update(PAGE, commands(send=globals()["send"], listen=listen)), commands(send=send))
    assert section(page, "gw send") == (
        "Send nothing.\n\n| option | what it does |\n|---|---|\n| `--source SOURCE` | Only this source. |\n\n"
        f"{SHARED_LINK}none.\n\nBy hand.\n"
    )


def test_a_new_command_has_its_section_at_the_end() -> None:
    page = update(PAGE, commands(send=send, listen=listen))
    assert page.rpartition("\n## ")[2].startswith("gw listen\n\nListen.\n")
