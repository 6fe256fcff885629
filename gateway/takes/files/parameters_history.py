"""The parameters of a source in a take: where they change, and which frames they describe."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rtc3d

from gateway.errors import ParametersError
from gateway.messages.texts import xml_bytes
from gateway.rtc3d.parameters import Parameters, differ_in_statistics_only
from gateway.rtc3d.parameters_xml import parse_parameters
from gateway.takes.files.component_rows import Array
from gateway.takes.files.spool import pieces


class ParametersEntry(NamedTuple):
    """Parameters of a server: when the gateway sent them (``parameters_t.utime``), their version and XML."""

    utime: int
    version: int
    parameters: Parameters
    xml: bytes

    def __repr__(self) -> str:
        """Return a summary: the XML may have megabytes."""
        return f"<ParametersEntry {self.version} at {self.utime}: {len(self.xml)} bytes of XML>"


def recorded_parameters(xml: bytes) -> Parameters | None:
    """Return the parameters in recorded XML, without any section if it is empty; None if it is unreadable."""
    try:
        return parse_parameters(xml).parameters if xml else Parameters()
    except ParametersError:
        return None


class ParametersHistory:
    """The parameters of one source in a take. They are repeated in it every few seconds."""

    def __init__(self) -> None:
        self.newest: ParametersEntry | None = None
        self.is_readable = True
        """Whether the XML of ``newest`` could be read; otherwise, its parameters have no section."""
        self._xml = b""

    def add(self, message: rtc3d.parameters_t) -> ParametersEntry | None:
        """Take the next message; return its content, None if it does not differ from the newest."""
        xml, version = xml_bytes(message.xml), message.parameters_version
        is_same_version = self.newest is not None and self.newest.version == version
        if is_same_version and differ_in_statistics_only(self._xml, xml):
            return None
        parameters = recorded_parameters(xml)
        self._xml, self.is_readable = xml, parameters is not None
        self.newest = ParametersEntry(message.utime, version, parameters or Parameters(), xml)
        return self.newest


def changes_in_order(parameters: Sequence[ParametersEntry]) -> list[ParametersEntry]:
    """Return the parameters of several recordings in the order of time, without repeated ones."""
    found: list[ParametersEntry] = []
    for entry in sorted(parameters, key=lambda entry: entry.utime):
        is_same_version = bool(found) and found[-1].version == entry.version
        if not (is_same_version and differ_in_statistics_only(found[-1].xml, entry.xml)):
            found.append(entry)
    return found


def entries_of_rows(utime: Array, version: Array, parameters: Sequence[ParametersEntry]) -> Array:
    """Return the index of the parameters that describe each row; -1 if there are none.

    Versions start again with the gateway. Of several parameters with the version of a row, the newest that
    are older than the row describe it, or else the first.
    """
    entries = np.full(len(utime), -1, np.min_scalar_type(-len(parameters) - 1))
    by_version: dict[int, list[int]] = {}
    for index in sorted(range(len(parameters)), key=lambda index: parameters[index].utime):
        by_version.setdefault(parameters[index].version, []).append(index)
    for start, stop in pieces(len(utime)):
        versions = version[start:stop]
        for number in np.unique(versions).tolist():
            indices = by_version.get(number, [])
            if not indices:
                continue
            rows = np.flatnonzero(versions == number) + start
            times = np.array([parameters[index].utime for index in indices], np.int64)
            found = np.searchsorted(times, utime[rows], side="right") - 1
            entries[rows] = np.array(indices)[np.maximum(found, 0)]
    return entries
