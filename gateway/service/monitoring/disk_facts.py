"""What metrics need from disks: when certificates end, and how much room there is for takes.

A disk may not respond, so all of this is read in a thread, once a minute.
"""

import asyncio
import contextlib
import shutil
import ssl
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from gateway.config.files import read_file
from gateway.config.settings import OutputSettings
from gateway.errors import ConfigError
from gateway.outputs.takes.settings import TakesSettings
from gateway.service.gateway import Gateway
from gateway.workers import WorkerThread

_PERIOD_S: Final = 60.0
_PEM_END: Final = "-----END CERTIFICATE-----"
_SEQUENCE: Final = 0x30
_VERSION: Final = 0xA0
_UTC_TIME: Final = 0x17


class DiskFacts:
    """Reads these facts of a gateway until ``close``; what cannot be read is left out."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._task: asyncio.Task[None] | None = None
        self.certificate_ends_s: Mapping[tuple[str, str], float] = {}
        """When certificates end, in s since the Unix epoch, by output and the key that names them."""
        self.takes_free_bytes: int | None = None
        """The room on the disk of the takes; None if the output is off."""

    def start(self) -> None:
        """Start reading, in the running event loop."""
        self._task = asyncio.create_task(self._read_again_and_again())

    def close(self) -> None:
        """Stop reading."""
        if self._task is not None:
            self._task.cancel()

    async def _read_again_and_again(self) -> None:
        thread = WorkerThread("disk-facts")
        while True:
            with contextlib.suppress(OSError):  # no thread can be started: the health says so
                outputs = self._gateway.settings.outputs
                facts = await thread.run(partial(_read, outputs))
                self.certificate_ends_s, self.takes_free_bytes = facts
            await asyncio.sleep(_PERIOD_S)


class _Facts(NamedTuple):
    certificate_ends_s: Mapping[tuple[str, str], float]
    takes_free_bytes: int | None


def _read(outputs: Mapping[str, OutputSettings]) -> _Facts:
    ends_s: dict[tuple[str, str], float] = {}
    free_bytes: int | None = None
    for name, settings in outputs.items():
        if not settings.enabled:
            continue
        for key, path in _certificates(settings).items():
            with contextlib.suppress(OSError, ValueError):  # the output itself says what is wrong with it
                ends_s[name, key] = min(_ends_s(read_file(path).decode("ascii")))
        if isinstance(settings, TakesSettings):
            with contextlib.suppress(OSError):
                free_bytes = shutil.disk_usage(settings.effective_directory).free
    return _Facts(ends_s, free_bytes)


def _certificates(settings: OutputSettings) -> Mapping[str, Path]:
    try:
        return settings.certificates
    except ConfigError:  # the file has changed since the gateway started
        return {}


def _ends_s(pem: str) -> Iterator[float]:
    """Yield when each certificate in a text ends, in s since the Unix epoch. Raises ValueError."""
    for text in pem.split(_PEM_END)[:-1]:
        begin = text.find("-----BEGIN CERTIFICATE-----")
        yield _end_s(ssl.PEM_cert_to_DER_cert(text[max(0, begin) :] + _PEM_END))


def _end_s(certificate: bytes) -> float:
    """Return when a certificate ends (RFC 5280, 4.1). Python's ssl has this for peers only."""
    fields = _elements(_elements(_elements(certificate, 1)[0][1], 1)[0][1], 5)
    fields = fields[fields[0][0] == _VERSION :]  # the version may be absent
    validity = fields[3]  # after serial number, algorithm and issuer
    if validity[0] != _SEQUENCE:
        raise ValueError("no validity")
    tag, text = _elements(validity[1], 2)[1]
    digits = text.decode("ascii")
    if tag == _UTC_TIME:  # with a year of two digits
        digits = ("20" if digits < "5" else "19") + digits
    return datetime.strptime(digits, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC).timestamp()


def _elements(data: bytes, most: int) -> list[tuple[int, bytes]]:
    """Return the tag and the content of the first ``most`` elements in DER. Raises ValueError."""
    found: list[tuple[int, bytes]] = []
    while data and len(found) < most:
        if len(data) < 2:
            raise ValueError("cut off")
        tag, size, start = data[0], data[1], 2
        if size & 0x80:
            start += size & 0x7F
            size = int.from_bytes(data[2:start])
        if len(data) < start + size:
            raise ValueError("cut off")
        found.append((tag, data[start : start + size]))
        data = data[start + size :]
    if len(found) < most:
        raise ValueError("too few elements")
    return found
