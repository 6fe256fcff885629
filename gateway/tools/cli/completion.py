"""What a shell offers for arguments and the values of options when the user presses Tab.

It must answer at once and print nothing else. So it reads files, but never asks on the network: that takes up
to a second. Where nothing is offered, the shell offers files.
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Final

import typer

from gateway.config.document import apply_overrides, read_yaml
from gateway.config.files import DEFAULT_CONFIG, SERVICE_STATE, folder_of, read_file

Completion = Callable[[str], list[str]]

_TAKE_SUFFIX: Final = ".lcmlog"
"""That of gateway.takes.files.reader, which takes long to import; a test compares them."""

_MAX_EVENTS: Final = 2000
"""How many events of a take are searched for the names of its sources, which are at its beginning."""

_MAX_ENTRIES: Final = 20_000
"""How many files of a folder are looked at."""

# The shell may evaluate the text, or split it at spaces, and files and takes may come from anywhere.
_SOURCE: Final = re.compile("[A-Za-z0-9_-]+")
_TAKE: Final = re.compile(r"[\w+][\w.+-]*")
_PATH: Final = re.compile(r"(?:~/)?[\w./+][\w./+,%-]*")


def one_of(words: Iterable[str]) -> Completion:
    """Return the completion of an option that has one of these values."""
    known = list(words)
    return lambda incomplete: [word for word in known if word.startswith(incomplete)]


def source_names(context: typer.Context, incomplete: str) -> list[str]:
    """Complete the name of a source: of the take on the command line, or of the configuration."""
    # Arguments before an option without a value, which is being completed, are not parsed yet.
    words = (context.params.get("take"), context.params.get("file"), *context.args)
    names: list[str] = []
    with suppress(Exception):  # whatever it is, the command itself will say it
        paths = [Path(word).expanduser() for word in words if word is not None]
        take = next((path for path in paths if path.exists()), None)
        if take is not None:
            from gateway.takes.files.event_log import EventLogReader
            from gateway.takes.files.reader import SourceNames, log_paths

            events = EventLogReader(log_paths(take)[0]).events()
            names = SourceNames(islice(events, _MAX_EVENTS)).names
        else:
            names = [str(source["name"]) for source in _configuration(context)["sources"]]
    return [name for name in names if _SOURCE.fullmatch(name) and name.startswith(incomplete)]


def take_names(context: typer.Context, incomplete: str) -> list[str]:
    """Complete the name of a take in the folder of the configuration, of the source that is given, if any."""
    names: set[str] = set()
    with suppress(Exception):
        settings = _configuration(context).get("takes") or {}
        for folder in _take_folders(settings.get("directory")):
            names |= _takes_in(folder, context.params.get("source") or "")
    return sorted(name for name in names if _TAKE.fullmatch(name) and name.startswith(incomplete))


def _configuration(context: typer.Context) -> Any:
    """Return the values of the file of ``--config``, or of the default configuration."""
    file = Path(context.params.get("config") or DEFAULT_CONFIG).expanduser()
    text = read_file(file).decode() if file.exists() else "{}"
    document = read_yaml(text, str(file))
    apply_overrides(document, os.environ)
    return document.values


def _take_folders(configured: str | None) -> Sequence[Path]:
    """Return the folders of takes: without a configured one, those of the user and of the service."""
    if configured is not None:
        return [Path(configured)]
    return [folder_of(None, "takes"), SERVICE_STATE / "takes"]


def _takes_in(folder: Path, source: str) -> set[str]:
    """Return the names of the takes in FOLDER/SOURCE, or in the folders of all sources."""
    sources = [folder / source] if source else [Path(entry) for entry in _entries(folder) if entry.is_dir()]
    entries = [entry for each in sources for entry in _entries(each)]
    logs = {entry.name.removesuffix(_TAKE_SUFFIX) for entry in entries if entry.name.endswith(_TAKE_SUFFIX)}
    return logs | {entry.name for entry in entries if entry.is_dir()}


def files_of(*suffixes: str) -> Completion:
    """Return the completion of the path of a file with one of these extensions; folders may have some, too.

    It offers nothing if there is no such file, or if a shell might read one of the paths otherwise, so that
    the shell completes it: it knows how to quote, and writes no space after a folder.
    """

    def complete(incomplete: str) -> list[str]:
        parent, slash, beginning = incomplete.rpartition("/")
        with suppress(Exception):
            entries = [*_entries(Path(parent + slash).expanduser())]
            found = [entry for entry in entries if _is_begun(entry.name, beginning)]
            folders = [entry.name for entry in found if entry.is_dir()]
            files = {entry.name for entry in found if entry.name.lower().endswith(suffixes)} - {*folders}
            paths = [parent + slash + name for name in (*files, *(f"{folder}/" for folder in folders))]
            if files and all(map(_PATH.fullmatch, paths)):
                return sorted(paths)
        return []

    return complete


def _is_begun(name: str, beginning: str) -> bool:
    """Return whether a name has this beginning; hidden files have more than none."""
    return name.startswith(beginning) and (beginning != "" or not name.startswith("."))


def _entries(folder: Path) -> Iterator["os.DirEntry[str]"]:
    """Yield what is in a folder, if it can be read."""
    with suppress(OSError), os.scandir(folder) as entries:
        yield from islice(entries, _MAX_ENTRIES)


take_files: Final = files_of(_TAKE_SUFFIX)
"""Completes the path of a take."""

c3d_files: Final = files_of(".c3d")
"""Completes the path of a C3D file."""
