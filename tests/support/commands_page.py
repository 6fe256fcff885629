"""Writes the help of all commands into docs/reference/commands.md: ``make options``.

The section of a command begins with its help, a table of its own options, and the names of those that it
shares with other commands, which have a section to themselves. People write only what follows.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from textwrap import fill
from typing import Any, Final

import typer

from gateway.tools.cli.main import app
from gateway.tools.cli.man_page import commands, help_text, is_option, value_word
from tests.support.documents import ROOT

PAGE: Final = ROOT / "docs/reference/commands.md"

_PROGRAM: Final = "rtc3d-gateway"
_SHARED: Final = "Shared options"
_HEADER: Final = "| option | what it does |\n|---|---|\n"
_NAMES: Final = "[Shared options](#shared-options): "
"""The beginning of the last paragraph that is generated for a command."""

_GENERATED: Final = re.compile(rf".*?^{re.escape(_NAMES)}.*?\.\n(?=\n|\Z)", re.DOTALL | re.MULTILINE)
_WIDTH: Final = 120


def program_commands() -> dict[str, Any]:
    """Return every command of the program by its full name."""
    return {f"{_PROGRAM} {name}": command for name, command in commands(typer.main.get_command(app))}


def update(page: str, program: Mapping[str, Any]) -> str:
    """Return ``page`` with the help of the commands; those that have no section are added at the end."""
    rows = {name: list(_rows(command)) for name, command in program.items()}
    shared = _shared_rows(row for each in rows.values() for row in each)
    beginning, *sections = re.split("^## ", page, flags=re.MULTILINE)
    texts = dict(section.split("\n", maxsplit=1) for section in sections)
    texts[_SHARED] = f"\n{_HEADER}{''.join(shared)}\n"
    for name, command in program.items():
        own = "".join(row for row in rows[name] if row not in shared)
        names = ", ".join(_name(row) for row in rows[name] if row in shared) or "none"
        parts = [
            *_paragraphs(command.help or ""),
            *([_HEADER + own] if own else []),
            _wrapped(f"{_NAMES}{names}."),
        ]
        if name not in texts:
            texts[next(reversed(texts))] += "\n"
        by_hand = _GENERATED.sub("", texts.get(name, ""), count=1)
        texts[name] = "\n" + "\n".join(parts) + by_hand
    return beginning + "".join(f"## {heading}\n{text}" for heading, text in texts.items())


def _rows(command: Any) -> Iterator[str]:
    """Yield a row of a table for each argument and option."""
    for parameter in command.params:
        if getattr(parameter, "hidden", False):
            continue
        names = [value_word(parameter)]
        if is_option(parameter):
            value = "" if parameter.is_flag else f" {names[0]}"
            names = [f"{parameter.opts[0]}{value}", *parameter.opts[1:]]
        yield f"| {', '.join(f'`{name}`' for name in names)} | {help_text(parameter)} |\n"


def _name(row: str) -> str:
    """Return the name of the option of a row, between backticks."""
    name = re.split("[ `]", row.removeprefix("| `"), maxsplit=1)[0]
    return f"`{name}`"


def _shared_rows(rows: Iterable[str]) -> list[str]:
    """Return the rows of options that several commands have, at most one for each name."""
    counts = Counter(row for row in rows if row.startswith("| `--"))
    shared: dict[str, str] = {}
    for row, count in counts.most_common():
        if count > 1:
            shared.setdefault(_name(row), row)
    return [row for row in counts if row in shared.values()]


def _paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a help, without those that repeat the table of exit statuses."""
    return [_wrapped(part) for part in text.split("\n\n") if not part.startswith("Exit status")]


def _wrapped(text: str) -> str:
    return fill(" ".join(text.split()), _WIDTH, break_on_hyphens=False) + "\n"


def main() -> None:
    """Write the page."""
    PAGE.write_text(update(PAGE.read_text(), program_commands()))


if __name__ == "__main__":
    main()
