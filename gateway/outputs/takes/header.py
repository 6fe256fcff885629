"""What each file of a take begins and ends with: its description, the newest parameters, what was lost."""

from dataclasses import dataclass
from pathlib import Path

from gateway import __version__
from gateway.messages.host_time import now_utime
from gateway.messages.topics import lcm_channel
from gateway.outputs.parameters_message import published_again
from gateway.takes.description import (
    NO_DETAILS,
    TakeDetails,
    encode_take,
    encode_take_details,
    encode_take_end,
)
from gateway.takes.recording import LogFile


@dataclass(frozen=True)
class SourceDescription:
    """A source in the files of a take. ``server`` is HOST:PORT, "" if it is not known."""

    source: str
    prefix: str
    server: str
    details: TakeDetails = NO_DETAILS

    def channel(self, *path: str) -> bytes:
        """Return the channel of the key with this path."""
        return lcm_channel(self.prefix, self.source, *path).encode()

    def messages(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return what describes the source in a file that begins at ``utime``, in µs since the Unix epoch."""
        take = encode_take(
            utime=utime,
            name=name,
            source=self.source,
            channels=lcm_channel(self.prefix, self.source),
            server=self.server,
            gateway_version=__version__,
            recorder="rtc3d-gateway",
        )
        messages = [(self.channel("take"), take)]
        if self.details != NO_DETAILS:
            details = encode_take_details(utime=utime, source=self.source, details=self.details)
            messages.append((self.channel("details"), details))
        return messages

    def end_message(self, utime: int, num_lost: int) -> bytes:
        """Return the ``take_end_t`` of a file that ends at ``utime`` and lacks ``num_lost`` messages."""
        return encode_take_end(utime=utime, source=self.source, messages_lost=num_lost)


class FileHeader:
    """The beginning of the files of one source.

    ``parameters`` is the newest ``parameters_t``, or None. It is used in the thread that writes,
    where ``parameters`` follows what is written.
    """

    def __init__(self, description: SourceDescription, parameters: bytes | None) -> None:
        self.description = description
        self.parameters = parameters
        self.parameters_channel: bytes = description.channel("parameters")
        self._end_channel = description.channel("end")

    def messages(self, name: str, utime: int) -> list[tuple[bytes, bytes]]:
        """Return the first messages of a file, each with its channel."""
        messages = self.description.messages(name, utime)
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

    def end_log(self, log: LogFile, num_lost: int) -> int:
        """Write the last message of a file; on a full disk, in place of the newest one.

        Returns how many messages the file lacks then. Raises OSError.
        """
        utime = now_utime()
        try:
            log.append([(self._end_channel, self.description.end_message(utime, num_lost))])
        except OSError:
            log.remove_newest()
            num_lost += 1
            log.append([(self._end_channel, self.description.end_message(utime, num_lost))])
        return num_lost
