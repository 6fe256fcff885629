"""What each file of a take begins with: its description, and the newest parameters of the source."""

import socket
from dataclasses import dataclass
from pathlib import Path

import rtc3d

from gateway import __version__
from gateway.messages.limits import encode_within_limits
from gateway.messages.topics import lcm_channel
from gateway.outputs.parameters_message import published_again
from gateway.takes.recording import LogFile


@dataclass(frozen=True)
class SourceDescription:
    """A source in the files of takes. ``server`` is HOST:PORT, "" if it is not known."""

    source: str
    prefix: str
    server: str

    def channel(self, *path: str) -> bytes:
        """Return the channel of the key with this path."""
        return lcm_channel(self.prefix, self.source, *path).encode()

    def take_message(self, name: str, utime: int) -> bytes:
        """Return the ``take_t`` of a file that begins at ``utime``, in µs since the Unix epoch."""
        message = rtc3d.take_t()
        message.utime = utime
        message.name = name
        message.source = self.source
        message.channels = lcm_channel(self.prefix, self.source)
        message.server = self.server
        message.gateway_version = __version__
        message.recorder = f"rtc3d-gateway {__version__}"
        message.host = socket.gethostname()
        return encode_within_limits(message)


class FileHeader:
    """The beginning of the files of one source.

    ``parameters`` is the newest ``parameters_t``, or None. It is used in the thread that writes,
    where ``parameters`` follows what is written.
    """

    def __init__(self, description: SourceDescription, parameters: bytes | None) -> None:
        self.description = description
        self.parameters = parameters
        self.parameters_channel: bytes = description.channel("parameters")
        self._take_channel = description.channel("take")

    def messages(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return the first messages of a file, each with its channel."""
        messages = [(self._take_channel, self.description.take_message(name, utime))]
        if self.parameters is not None:
            messages.append((self.parameters_channel, published_again(self.parameters, utime)))
        return messages

    def begin_log(self, path: Path, name: str, utime: int) -> LogFile:
        """Create a file with these messages. Raises OSError; then there is no file."""
        messages = self.messages(name, utime)
        log = LogFile(path)
        try:
            while messages:
                messages = messages[log.append(messages) :]
        except OSError:
            log.close()
            path.unlink(missing_ok=True)
            raise
        return log
