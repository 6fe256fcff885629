"""The doctor's checks of the takes: the folder, the space on its disk, and hard links."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from gateway.outputs.findings import Check, Finding, MessageLoad, failing_first
from gateway.outputs.takes.folder import check_directory, disk_problem
from gateway.outputs.takes.settings import TAKES, TakesSettings

_FEW_MINUTES: Final = 60.0
_GIB: Final = 1024**3

_FOLDER, _SPACE, _LINKS = (Check("takes", name) for name in TAKES.checks)


def check_takes(
    settings: TakesSettings, _sources: Sequence[str], loads: Sequence[MessageLoad], _seconds: float
) -> list[Finding]:
    """Check that takes can be recorded; ``loads`` say how long the disk lasts."""
    directory = settings.effective_directory
    if not directory.exists():
        note = _FOLDER.note(f"{directory} does not exist yet", "The gateway creates it when it starts.")
        return [note, *(each.not_tested("the folder does not exist yet") for each in (_SPACE, _LINKS))]
    try:
        check_directory(directory)
        with _probe(directory):
            pass
    except OSError as error:
        return failing_first(_FOLDER.problem(disk_problem(directory, error)), TAKES.checks[1:])
    writable = _FOLDER.passing(f"{directory} can be written")
    return [writable, _check_space(settings, loads), _check_links(settings)]


@contextlib.contextmanager
def _probe(directory: Path) -> Iterator[Path]:
    """Create a file for the block. Raises OSError."""
    path = directory / f".doctor-{secrets.token_hex(4)}"
    path.write_bytes(b"test")
    try:
        yield path
    finally:
        path.unlink()


def _check_space(settings: TakesSettings, loads: Sequence[MessageLoad]) -> Finding:
    free_bytes = shutil.disk_usage(settings.effective_directory).free
    found = f"{free_bytes / _GIB:.1f} GiB are free"
    rate = sum(load.rate_hz * load.largest_bytes for load in loads)
    if not rate:
        return _SPACE.passing(f"{found}; no frames arrived, so the rate of a take is unknown")
    minutes = min(free_bytes, settings.max_bytes) / rate / 60
    limit = "takes.max_bytes" if settings.max_bytes < free_bytes else "the disk"
    found += (
        f"; a take has {60 * rate / 2**20:.1f} MiB a minute, so {limit} is full after {minutes:.0f} minutes"
    )
    if minutes >= _FEW_MINUTES:
        return _SPACE.passing(found)
    return _SPACE.warning(found, "Make room on the disk, choose another folder, or raise takes.max_bytes.")


def _check_links(settings: TakesSettings) -> Finding:
    if not settings.keep_last_s:
        return _LINKS.not_tested("takes.keep_last_s is 0")
    directory = settings.effective_directory
    try:
        with _probe(directory) as path:
            link = path.with_name(f"{path.name}-link")
            os.link(path, link)
            link.unlink()
    except OSError as error:
        return _LINKS.failing(
            f"the file system of {directory} has no hard links ({error.strerror}), which saving takes needs",
            "Choose a folder on ext4, XFS or Btrfs as takes.directory.",
        )
    return _LINKS.passing("the last seconds can be saved without copying")
