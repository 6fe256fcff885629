"""The registry of export formats. All code that lists formats reads it.

The formats of this package are in tables. Other packages add theirs as entry points of GROUP, with extensions
as names (docs/how-to/write-an-export-format.md). The first export imports them, and a format of this package
is imported when it is used: the command line lists the formats, and numpy is slow to import.
"""

import re
import traceback
from collections.abc import Callable, Collection, Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from gateway.errors import ConfigError, GatewayError, TakeError
from gateway.rtc3d.component_types import COMPONENTS_BY_KEY

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from gateway.takes.export.job import ExportJob

GROUP: Final = "gateway.export_formats"
"""The group of entry points in which packages name their Format."""


class Format(NamedTuple):
    """A format: the function that writes the files of a job, and what they keep of a take.

    ``components`` are the keys of those that it has; ``keeps_details`` says whether it has the subject, the
    session and the note. ``lacks`` is what else it never has, in words, by the component that has it, or
    "parameters"; "" stands for all components.
    """

    write: Callable[["ExportJob"], None]
    components: Collection[str] = COMPONENTS_BY_KEY.keys()
    keeps_details: bool = True
    lacks: Mapping[str, str] = MappingProxyType({})


def _imported_late(path: str, package: str = "", extra: str = "") -> Callable[["ExportJob"], None]:
    """Return the function ``MODULE:NAME`` of this folder, which is imported when it is called.

    If the module needs a ``package`` that is not installed, the call raises TakeError, which names the
    ``extra`` that installs it.
    """
    module, _, name = path.partition(":")

    def write(job: "ExportJob") -> None:
        try:
            found = getattr(import_module(f"gateway.takes.export.{module}"), name)
        except ImportError as error:
            if not package:
                raise
            raise TakeError(
                f"{job.out} cannot be written without {package}; "
                f"install it: pip install 'rtc3d-gateway[{extra}]'"
            ) from error
        found(job)

    return write


_FOXGLOVE: Final = ("foxglove-sdk", "foxglove")
_RELIABILITIES: Final = {"3d": "reliabilities of markers"}
_PARAMETERS: Final = {"parameters": "parameters except labels and units"}
_FOR_VIEWERS: Final = {"6d": "errors of tools", "": "frame numbers, server's time stamps"}

FORMATS: Final = {
    ".c3d": Format(_imported_late("c3d:export_c3d"), ("3d", "analog", "force", "event")),
    ".trc": Format(_imported_late("trc:export_trc"), ("3d",), keeps_details=False, lacks=_RELIABILITIES),
    ".mot": Format(_imported_late("opensim:export_mot"), ("force",), keeps_details=False),
    ".sto": Format(_imported_late("opensim:export_sto"), ("analog",), keeps_details=False),
    ".csv": Format(_imported_late("csv_files:export_csv"), keeps_details=False, lacks=_PARAMETERS),
    ".parquet": Format(_imported_late("parquet:export_parquet", "pyarrow", "parquet"), lacks=_PARAMETERS),
    ".mcap": Format(_imported_late("mcap:export_mcap", *_FOXGLOVE), lacks=_FOR_VIEWERS),
}
"""The formats by the extension of the new file; ``add_installed_formats`` adds those of other packages."""

CHOSEN_FORMATS: Final = {
    "opensim": Format(
        _imported_late("opensim:export_opensim"),
        ("3d", "analog", "force"),
        keeps_details=False,
        lacks=_RELIABILITIES,
    ),
    "bids": Format(_imported_late("bids:export_bids")),
    "ros2": Format(
        _imported_late("rosbag:export_rosbag", *_FOXGLOVE),
        ("3d", "6d", "analog", "force", "event"),
        lacks=_FOR_VIEWERS,
    ),
}
"""The formats that an option chooses."""

UNUSABLE: Final[dict[str, str]] = {}
"""By extension, why the format of another package cannot be used."""


@cache
def add_installed_formats() -> None:
    """Add the formats of other packages to FORMATS, and to UNUSABLE those that cannot be used, once."""
    from gateway.runtime.entry_points import add_installed  # noqa: PLC0415 - slow, see above

    unusable = add_installed(GROUP, "export format", _add)
    UNUSABLE.update({f".{name}": text for name, text in unusable.items()})


def _add(entry: "EntryPoint") -> None:
    """Add the format of an entry point. Raises ConfigError, and whatever its module raises."""
    extension = f".{entry.name}"
    if extension in FORMATS or re.fullmatch("[a-z0-9][a-z0-9_-]*", entry.name) is None:
        raise ConfigError(
            f"the extension {entry.name!r} is taken, or has other characters than a to z, 0 to 9, _ and -"
        )
    found = entry.load()
    if not isinstance(found, Format):
        raise ConfigError(f"{entry.value} is of the type {type(found).__name__}, not Format")
    FORMATS[extension] = found._replace(write=_naming_package(entry, found.write))


def _naming_package(
    entry: "EntryPoint", write: Callable[["ExportJob"], None]
) -> Callable[["ExportJob"], None]:
    """Return ``write`` with TakeError in place of its defects, which would seem to be the gateway's."""

    def call(job: "ExportJob") -> None:
        from gateway.runtime.entry_points import package_of  # noqa: PLC0415 - slow, see above

        try:
            write(job)
        except (GatewayError, OSError):
            raise
        except Exception as error:
            # The line of ``write``, if it is Python.
            where = traceback.extract_tb(error.__traceback__)[:2][-1]
            raise TakeError(
                f"{job.out} was not written: defect in the export format {entry.name} of the package "
                f"{package_of(entry)}: {type(error).__name__}: {error} ({where.filename}:{where.lineno}); "
                "report this to those who wrote the package"
            ) from error

    return call
