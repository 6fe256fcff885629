"""Every error of the gateway, one tree.

::

    GatewayError                  whatever this package raises on purpose
    ├── ConfigError               a configuration cannot be used: every problem, with file and line
    ├── TakeError                 a C3D file cannot be played
    ├── ProtocolError             bytes that break RTC3D
    │   ├── PacketError           §4: a size out of bounds; the connection cannot go on
    │   ├── FrameError            §7: sizes and counts contradict each other; this frame is lost
    │   ├── CommandError          §5: a text that is no command of the protocol
    │   └── ParametersError       §6: no parameters can be read from the XML
    ├── ServerError               the server answered with an error packet (type 0)
    ├── LinkError                 a connection to a server is not, or no longer, to be used
    │   ├── ConnectError          it could not be made
    │   ├── ReplyTimeoutError     a command was not answered in time
    │   ├── SilenceError          nothing came although a measurement runs
    │   └── ClosedError           it ended: by the server, by us, or by the network
    ├── OutputError               a message could not be handed to Zenoh or LCM
    ├── SpoolError                a C3D file from a server could not be kept
    └── QueryError                a peer's question cannot be answered; the text goes to the peer

A message says what happened, to which server or file, and what to do about it.
"""


class GatewayError(Exception):
    """Base of all errors that the gateway raises on purpose."""


class ConfigError(GatewayError):
    """A configuration cannot be used. The text holds one line per problem: file, line, key, remedy."""


class TakeError(GatewayError):
    """A C3D file cannot be played by the simulator."""


class ProtocolError(GatewayError):
    """Bytes that break RTC3D."""


class PacketError(ProtocolError):
    """A packet's size is out of bounds (§4.1): the next packet's start is unknown, the connection ends.

    ``begin`` is how the packet begins, up to 60 bytes of it: it may show what talks there instead.
    """

    def __init__(self, message: str, *, size: int, packet_type: int, offset: int, begin: bytes = b"") -> None:
        super().__init__(message)
        self.size = size
        self.packet_type = packet_type
        self.offset = offset
        self.begin = begin


class FrameError(ProtocolError):
    """A data frame contradicts itself (§7): it is rejected whole, and the session goes on with the next."""


class CommandError(ProtocolError):
    """A text is no command of the protocol (§5); the message is fit for the error packet's body."""


class ParametersError(ProtocolError):
    """No parameters can be read from what the server sent as XML (§6)."""


class ServerError(GatewayError):
    """The server answered a command with an error packet (type 0); the message holds its text."""


class LinkError(GatewayError):
    """A connection to a server is not, or no longer, to be used."""


class ConnectError(LinkError):
    """A connection could not be made."""


class ReplyTimeoutError(LinkError):
    """A command was not answered in time."""


class SilenceError(LinkError):
    """Nothing came from the server although something should have."""


class ClosedError(LinkError):
    """The connection ended."""


class OutputError(GatewayError):
    """A message could not be handed to Zenoh or LCM; ``cause`` is the short name it is counted under."""

    def __init__(self, message: str, *, cause: str) -> None:
        super().__init__(message)
        self.cause = cause


class SpoolError(GatewayError):
    """A C3D file from a server could not be kept."""


class QueryError(GatewayError):
    """A peer's question cannot be answered. The text goes to the peer, ``code`` to its program.

    ``code`` is bad-request (ask otherwise), no-connection (the server is away), refused (the server
    said no), timeout (it said nothing) or nothing-yet (there is none so far).
    """

    def __init__(self, message: str, *, code: str = "bad-request") -> None:
        super().__init__(message)
        self.code = code
