"""What a shell offers for the values of options when the user presses Tab.

A completion must answer at once and print nothing else. So it reads files, but never asks on the network:
finding a gateway on Zenoh takes up to half a second, and on LCM a whole one.
"""

import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final

import typer

from gateway.config.files import DEFAULT_CONFIG

VARIABLE: Final = "_RTC3D_GATEWAY_COMPLETE"
"""The environment variable by which a shell asks for completions."""

_MAX_EVENTS: Final = 2000
"""How many events of a take are searched for the names of its sources, which are at its beginning."""


def is_completion() -> bool:
    """Return whether a shell runs the program to complete a command line."""
    return VARIABLE in os.environ


def one_of(words: Iterable[str]) -> Callable[[str], list[str]]:
    """Return the completion of an option that has one of these values."""
    known = list(words)
    return lambda incomplete: [word for word in known if word.startswith(incomplete)]


def source_names(context: typer.Context, incomplete: str) -> list[str]:
    """Complete the name of a source: of the take on the command line, or of the default configuration."""
    names: list[Any] = []
    with suppress(Exception):  # whatever it is, the command itself will say it
        take = _take_on_the_line(context)
        names = _configured_sources() if take is None else _sources_of_take(take)
    # The shell may evaluate the text, and a take may come from anywhere.
    return [name for name in names if re.fullmatch("[A-Za-z0-9_-]+", name) and name.startswith(incomplete)]


def _take_on_the_line(context: typer.Context) -> Path | None:
    """Return the take that the command is to read; None if there is none."""
    # Arguments before an option without a value, which is being completed, are not parsed yet.
    words = (context.params.get("take"), context.params.get("file"), *context.args)
    return next((Path(word) for word in words if word is not None and Path(word).exists()), None)


def _sources_of_take(path: Path) -> list[str]:
    from gateway.takes.files.event_log import EventLogReader
    from gateway.takes.files.reader import SourceNames, log_paths

    events = EventLogReader(log_paths(path)[0]).events()
    return SourceNames(islice(events, _MAX_EVENTS)).names


def _configured_sources() -> list[str]:
    from gateway.config.document import apply_overrides, read_yaml
    from gateway.config.files import read_file

    text = read_file(DEFAULT_CONFIG).decode() if DEFAULT_CONFIG.exists() else "{}"
    document = read_yaml(text, str(DEFAULT_CONFIG))
    apply_overrides(document, os.environ)
    return [str(source["name"]) for source in document.values["sources"]]
