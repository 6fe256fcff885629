"""The sources that gateways serve, found on Zenoh or LCM, with what the gateways report about them."""

from collections.abc import Iterable
from typing import Final

from gateway.client.series import FINGERPRINTS
from gateway.errors import ProtocolError
from gateway.logs.safe_text import safe_text
from gateway.messages.decode import decode
from gateway.messages.source_report import SourceReport, source_report

MAX_SOURCES: Final = 1000
"""How many sources are kept. Anybody on the network can send some."""

MAX_STATUS_BYTES: Final = 256 * 1024
_MAX_TOTAL_BYTES: Final = 4 * 1024 * 1024
"""What all statuses together may have: decoding takes about 1 s for this much."""

NO_ANSWER: Final = "its gateway does not answer"


class FoundSources:
    """Collects the sources that are found, up to MAX_SOURCES, each with its newest status."""

    def __init__(self) -> None:
        self._sources: dict[tuple[str, ...], SourceReport] = {}
        self._num_bytes = 0
        self.heard: set[str] = set()
        """The names of all sources that were heard, wanted or not, up to MAX_SOURCES."""
        self.num_left_out = 0
        """How many sources or statuses were left out, because there are too many."""
        self.absence = ""
        """Why nothing is found, or that the wanted source is not."""

    @property
    def sources(self) -> list[SourceReport]:
        """The sources by name, server and computer."""
        return sorted(
            self._sources.values(),
            key=lambda each: (each.name, each.gateway, each.problem, each.server, each.host, each.version),
        )

    @property
    def readable_names(self) -> list[str]:
        """The names of the sources whose status could be read, each once, sorted."""
        return sorted({each.name for each in self._sources.values() if each.streams or not each.problem})

    def add_status(self, message: bytes, name: str = "", gateway: str = "") -> None:
        """Add the source of a ``status_t``: see ``read_status``."""
        if self.takes(message):
            self.add(read_status(message, name, gateway))

    def takes(self, message: bytes) -> bool:
        """Return whether a message may still be read; count it as left out if not."""
        self._num_bytes += len(message)
        self.num_left_out += self._num_bytes > _MAX_TOTAL_BYTES
        return self._num_bytes <= _MAX_TOTAL_BYTES

    def hear(self, name: str) -> None:
        """Note the name of a source, wanted or not."""
        if len(self.heard) < MAX_SOURCES:
            self.heard.add(safe_text(name))

    def add_silent(self, names: Iterable[str]) -> None:
        """Add sources whose gateways do not answer."""
        for name in names:
            self.add(SourceReport(safe_text(name), problem=NO_ANSWER))

    def add(self, source: SourceReport) -> None:
        """Add a source, or replace what an earlier status said about it."""
        where = (source.gateway,) if source.gateway else (source.server, source.host)
        identity = (source.name, *where)
        if identity in self._sources or len(self._sources) < MAX_SOURCES:
            self._sources[identity] = source
        else:
            self.num_left_out += 1


def read_status(message: bytes, name: str, gateway: str = "") -> SourceReport:
    """Return what a status says about the source ``name``; if that is "", the status names it.

    The message may come from anybody, and from another version of the gateway.
    """
    problem = "its status is of another version of rtc3d-gateway"
    if len(message) > MAX_STATUS_BYTES:
        problem = f"its status is too long: {len(message)} bytes"
    elif message.startswith(FINGERPRINTS["status"]):
        try:
            return source_report(decode(message), name, gateway)
        except ProtocolError as error:
            problem = f"its status cannot be read: {error}"
    return SourceReport(safe_text(name), gateway, problem)
