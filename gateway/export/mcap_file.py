"""An MCAP file that is being written, with foxglove-sdk."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import IO, Final, Self

import foxglove
from foxglove.mcap import MCAPCompression, MCAPWriteOptions

from gateway.errors import TakeError
from gateway.foxglove_schemas.topics import FoxgloveMessage, Topic

_MAX_CHANNELS: Final = 1000
"""More can only come from labels that change all the time."""

# foxglove-sdk logs errors of the file, which McapFile raises. Without a handler, they would go to stderr.
logging.getLogger("foxglove").addHandler(logging.NullHandler())


class McapFile:
    """An MCAP file in chunks compressed by zstd. The end of the block writes its index.

    The file itself stays open. Its errors are raised by the next call, and at the end of the block.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.num_messages = 0
        self._file = _WatchedFile(file)
        self._context = foxglove.Context()
        self._channels: dict[Topic, foxglove.Channel] = {}
        options = MCAPWriteOptions(compression=MCAPCompression.Zstd)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
        except Exception:
            if error is None and not self._file.has_failed:
                raise
        self._file.raise_error()  # in place of foxglove-sdk's own

    def write(self, message: FoxgloveMessage) -> None:
        """Append a message."""
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._create_channel(message.topic)
        channel.log(message.data, log_time=message.utime * 1000)
        self.num_messages += 1
        self._file.raise_error()

    def write_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a table of texts."""
        self._writer.write_metadata(name, content)

    def attach(self, utime: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file in the file. ``utime`` is its time in µs since 1970."""
        self._writer.attach(
            log_time=utime * 1000, create_time=utime * 1000, name=name, media_type=media_type, data=data
        )

    def _create_channel(self, topic: Topic) -> foxglove.Channel:
        if len(self._channels) == _MAX_CHANNELS:
            raise TakeError(
                f"the labels in the take change so often that there would be more than {_MAX_CHANNELS} "
                "channels; choose a part by --from and --to"
            )
        schema = foxglove.Schema(name=topic.schema_name, encoding=topic.schema_encoding, data=topic.schema)
        channel = foxglove.Channel(
            topic.name, schema=schema, message_encoding=topic.encoding, context=self._context
        )
        self._channels[topic] = channel
        return channel


class _WatchedFile:
    """A file whose errors foxglove-sdk would log only."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._error: BaseException | None = None

    @property
    def has_failed(self) -> bool:
        """Whether there was an error."""
        return self._error is not None

    def raise_error(self) -> None:
        """Raise the first error of the file, if there was one."""
        if self._error is not None:
            raise self._error

    def write(self, data: bytes | bytearray) -> int:
        """See IO.write."""
        with self._watched():
            return self._file.write(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """See IO.seek."""
        with self._watched():
            return self._file.seek(offset, whence)

    def flush(self) -> None:
        """See IO.flush."""
        with self._watched():
            self._file.flush()

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self._error = self._error or error
            raise
