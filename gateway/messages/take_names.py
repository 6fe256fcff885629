"""The names of takes, which become those of files."""

import re
import time
from pathlib import Path
from typing import Final

from gateway.errors import QueryError

MAX_NAME_LENGTH: Final = 100

_NAME: Final = re.compile(r"[\w.+-][\w .+-]*")
_EXTENSION: Final = re.compile(r"\.[A-Za-z]\w{1,4}$")
_OTHER: Final = re.compile(r"[^\w .+-]")
_NUMBER: Final = re.compile(r"(\d+)")


def check_name(name: str) -> None:
    """Raise QueryError unless a take can have this name, which becomes that of a file."""
    if not name or len(name) > MAX_NAME_LENGTH or not _NAME.fullmatch(name) or name[0] == ".":
        raise QueryError(
            f"{name[:MAX_NAME_LENGTH]!r} cannot be the name of a take: expected 1 to {MAX_NAME_LENGTH} "
            "letters, digits, spaces and any of '_.-+', without a space or a dot at the beginning"
        )


def name_of_file(path: str) -> str:
    """Return the name of the take of a server's file: without folder, extension and what no take can have.

    Returns "" if nothing remains.
    """
    name = _EXTENSION.sub("", re.split(r"[\\/]", path)[-1].strip("'\" "))
    return _OTHER.sub("_", name).lstrip(" .")[:MAX_NAME_LENGTH]


def default_name(source: str) -> str:
    """Return the name of a take that begins now: SOURCE-YYYYMMDD-hhmmss, in local time."""
    return f"{source}-{time.strftime('%Y%m%d-%H%M%S')}"


def numbered(name: str, number: int) -> str:
    """Return NAME, NAME-2, NAME-3, … for the numbers from 1 on."""
    return name if number == 1 else f"{name}-{number}"


def by_number(path: Path) -> tuple[list[str | int], str]:
    """Return the key that sorts files by name, and the numbers in names by value: 999 before 1000."""
    parts = _NUMBER.split(path.name)
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], path.name
