"""What each file of a take begins with: its description, and the newest parameters of the source."""

from dataclasses import dataclass
from pathlib import Path

from gateway import __version__
from gateway.messages.topics import lcm_channel
from gateway.outputs.parameters_message import published_again
from gateway.takes.description import encode_take
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
        return encode_take(
            utime=utime,
            name=name,
            source=self.source,
            channels=lcm_channel(self.prefix, self.source),
            server=self.server,
            gateway_version=__version__,
            recorder="rtc3d-gateway",
        )


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
