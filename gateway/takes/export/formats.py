"""The formats to which takes are exported, by extension."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from gateway.config.words import join_or
from gateway.errors import SelectionError, TakeError
from gateway.takes.export.c3d import export_c3d
from gateway.takes.export.csv_files import export_csv
from gateway.takes.export.job import ExportJob
from gateway.takes.export.trc import export_trc

_INSTALL: Final = "pip install 'rtc3d-gateway[foxglove]'"


def _export_mcap(job: ExportJob) -> None:
    """See export_mcap. Raises TakeError if foxglove-sdk is not installed."""
    try:
        from gateway.takes.export.mcap import export_mcap  # noqa: PLC0415 - it needs an optional extra
    except ImportError as error:
        raise TakeError(
            f"{job.out} cannot be written without foxglove-sdk; install it: {_INSTALL}"
        ) from error
    export_mcap(job)


FORMATS: Final[dict[str, Callable[[ExportJob], None]]] = {
    ".c3d": export_c3d,
    ".trc": export_trc,
    ".csv": export_csv,
    ".mcap": _export_mcap,
}
"""What writes the files of a job, by the extension of its ``out``."""


def export_take(job: ExportJob) -> list[Path]:
    """Write the files of a job, and return their names. Raises TakeError; then none of them exists."""
    write = FORMATS.get(job.out.suffix.lower())
    if write is None:
        raise SelectionError(f"{job.out} has no known extension; choose {join_or(FORMATS)}")
    with job.files:
        write(job)
    return job.files.paths
