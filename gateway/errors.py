"""All errors of the gateway, in one tree below GatewayError.

- ConfigError, ServerError, PortError, OutputError, PeerError, SpoolError, ViewError, QueryError, ForkError
- TakeError: SelectionError
- ProtocolError: PacketError, FrameError, CommandError, ParametersError
- LinkError: ConnectError, ReplyTimeoutError, SilenceError, RequestError, DefectError, ClosedError

A message says what happened, to which server or file, and what to do.
"""

import errno
import os
from enum import StrEnum
from typing import Final


class GatewayError(Exception):
    """Base of all errors that this package raises on purpose."""


class ConfigError(GatewayError):
    """A configuration is invalid. The text has one line per problem: file, line, key, remedy."""


class TakeError(GatewayError):
    """A recording, an event log or a C3D file, cannot be read, played, written or converted."""


class SelectionError(TakeError):
    """A recording lacks the source or part that options choose, or there is no format for an extension."""


class ProtocolError(GatewayError):
    """Bytes violate RTC3D."""


class PacketError(ProtocolError):
    """A packet's size is out of bounds (§4.1); the next packet cannot be found, so the connection ends.

    ``size`` and ``packet_type`` are the header's fields, ``offset`` is the packet's position in the stream
    in bytes. ``first_bytes`` are up to 60 bytes of it; they may show which other protocol this is.
    """

    def __init__(
        self, message: str, *, size: int, packet_type: int, offset: int, first_bytes: bytes = b""
    ) -> None:
        super().__init__(message)
        self.size = size
        self.packet_type = packet_type
        self.offset = offset
        self.first_bytes = first_bytes


class FrameError(ProtocolError):
    """Sizes and counts in a data frame contradict each other (§7); it is rejected, the session continues."""


class CommandError(ProtocolError):
    """A text is not a command of the protocol (§5); the message can be the body of an error packet."""


class ParametersError(ProtocolError):
    """No parameters can be read from the server's XML (§6)."""


class ServerError(GatewayError):
    """The server answered a command with an error packet (type 0); the message is its text."""


class LinkError(GatewayError):
    """A connection to a server is not usable."""


class ConnectError(LinkError):
    """A connection could not be opened."""


class ReplyTimeoutError(LinkError):
    """A command was not answered in time."""


class SilenceError(LinkError):
    """Nothing arrived from the server although something should have."""


class RequestError(LinkError):
    """The server accepts no request for frames."""


class DefectError(LinkError):
    """A defect in this program ended the connection; ``__cause__`` is the exception."""


class ClosedError(LinkError):
    """The connection was closed."""


class PortError(GatewayError):
    """A server cannot listen on its port. The text says what to do."""


class OutputError(GatewayError):
    """An output did not open or did not accept a message; such a drop is counted under ``cause``."""

    def __init__(self, message: str, *, cause: str) -> None:
        super().__init__(message)
        self.cause = cause


class PeerError(GatewayError):
    """A client of an output violates its protocol, or speaks another one; the connection must end."""


class FileLoss(StrEnum):
    """Why a C3D file from a server was not stored."""

    NO_C3D_FILE = "no-c3d-file"
    TOO_LARGE = "too-large"  # spool.max_bytes
    BROKEN_OFF = "broken-off"  # by the end of the connection
    NOT_WRITTEN = "not-written"  # the system says why
    NO_MEMORY = "no-memory"  # for what waits for the disk
    DISK_BUSY = "disk-busy"  # with earlier files
    DISK_SILENT = "disk-silent"
    TOO_OFTEN = "too-often"


class SpoolError(GatewayError):
    """A C3D file from a server could not be stored, because of ``cause``."""

    def __init__(self, message: str, *, cause: FileLoss) -> None:
        super().__init__(message)
        self.cause = cause


class ViewError(GatewayError):
    """The live view cannot be served: viser is not installed, or its port is in use."""


class QueryError(GatewayError):
    """A peer's query cannot be answered. The text is for the person who asked, ``code`` for the program.

    The gateway's replies have these codes: bad-request (change the query), no-connection (the server is
    not connected), refused (by the server), timeout (the server did not answer), unreadable (its answer
    cannot be read), nothing-yet (no data so far), busy and rate (too many queries), disabled (in the
    configuration), disk (the folder of the takes cannot be used) and defect (in the gateway).
    The command ``params`` adds no-gateway and zenoh for problems of its own.
    """

    def __init__(self, message: str, *, code: str = "bad-request") -> None:
        super().__init__(message)
        self.code = code


class ForkError(GatewayError):
    """A connection to gateways cannot be used, because the process is a fork of the one that opened it."""


NO_FILES: Final = frozenset({errno.EMFILE, errno.ENFILE})
"""The system's errors if the process, or the computer, has no file descriptor left."""

FILES_ADVICE: Final = (
    "close programs that are connected to the gateway, or let it open more (LimitNOFILE of the service)"
)


def system_reason(error: OSError) -> str:
    """Return what the system says about an error, without what libraries add to it."""
    if error.errno is not None and error.errno > 0:  # those of getaddrinfo are negative
        return os.strerror(error.errno)
    return error.strerror or str(error)


def raise_unless_defect(error: BaseException) -> None:
    """Raise ``error`` again if it ends the program or a task. A panic of a library in Rust does not.

    Such a panic (PyO3's PanicException, one class for each library) is a BaseException, and no Exception.
    """
    if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
        raise error
