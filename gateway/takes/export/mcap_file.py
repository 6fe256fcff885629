"""MCAP files: writing one, and the part of an export that is the same for Foxglove and for ROS 2.

The file is written while the take is read, so its size does not matter. The messages of a topic are encoded
and written many at a time, because a few calls for each message would take several times as long.
"""

import logging
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from types import TracebackType
from typing import IO, Any, Final, Self

import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions

from gateway.errors import TakeError
from gateway.messages.encode import metres_per_unit
from gateway.messages.foxglove.topics import MAX_UTIME, FoxgloveTopic, TopicMessages
from gateway.rtc3d.parameters import differ_in_statistics_only
from gateway.takes.export.changed_labels import note_labels
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.export.tables import parts_of
from gateway.takes.files.component_rows import Array
from gateway.takes.files.series import Series
from gateway.takes.files.take import Take, TakeSource

_MAX_CHANNELS: Final = 1000
"""More can only come from labels that change all the time."""

_MAX_LATE_US: Final = 5_000_000
"""Messages that arrive in a take at the same time were captured within this."""

# foxglove-sdk logs errors of the file, which McapFile raises. Without a handler, they would go to stderr.
logging.getLogger("foxglove").addHandler(logging.NullHandler())


class SourceExport(ABC):
    """One source of a take on its way to a file."""

    def __init__(self) -> None:
        self.left_out: Counter[str] = Counter()
        """How many messages or items were left out, by what they are."""
        self.notes: dict[str, None] = {}
        """What else was changed, in this order."""

    def messages(self, key: str, run: Series) -> Iterable[TopicMessages]:
        """Return the messages of frames with constant labels and units."""
        is_valid = (run.capture_utime >= 0) & (run.capture_utime <= MAX_UTIME)
        self.count(f"messages from before 1970 or after 2106 in {key}", ~is_valid)
        (rows,) = np.nonzero(is_valid)
        return self.messages_of(key, run, rows) if len(rows) else ()

    @abstractmethod
    def messages_of(self, key: str, run: Series, rows: Array) -> Iterable[TopicMessages]:
        """Return the messages of some rows, whose times are possible."""

    def labels_of(self, run: Series) -> Sequence[str]:
        """Return what the items of frames with constant labels are called in the file."""
        return run.labels

    def count(self, what: str, rows: Array) -> None:
        """Count rows (where the array is true) that are left out."""
        count = int(rows.sum())
        if count:
            self.left_out[what] += count


def export_to_mcap(
    job: ExportJob, new_export: Callable[[TakeSource], SourceExport], content: str, profile: str = ""
) -> None:
    """Write the sources of a take to one file, with the servers' parameters attached.

    ``content`` says what the format can hold, for a take that has nothing of it.
    """
    take = job.open_take(components=())
    _note_metres(job, take)
    exports: dict[str, SourceExport] = {}
    with McapFile(job.files.create(job.out), profile) as file:
        for part in parts_of(job, take):
            for name, key, series in part:
                if name not in exports:
                    exports[name] = new_export(take.sources[name])
                job.count_recorded(name, key, len(series))
                for run in series.runs():
                    note_labels(job, name, run, exports[name].labels_of(run))
                    num_messages: Counter[FoxgloveTopic] = Counter()
                    for messages in exports[name].messages(key, run):
                        file.add(messages)
                        num_messages[messages.topic] += len(messages.messages)
                    # Not every topic has every row: there are tools that are not in view.
                    job.rows.written[name, key] += max(num_messages.values(), default=0)
            file.write_most()
        for source in take.sources.values():
            file.describe(source)
    if not file.num_messages:
        raise nothing_to_export(job, content)
    _report(job, take, exports)


def _note_metres(job: ExportJob, take: Take) -> None:
    """Report that positions are converted to m."""
    for source in take.sources.values():
        for entry in source.parameters:
            parameters = entry.parameters
            unit = parameters.length_unit
            if (parameters.markers or parameters.tools) and metres_per_unit(unit) not in {None, 1.0}:
                job.note(f"positions converted from {unit} to m")


def _report(job: ExportJob, take: Take, exports: dict[str, SourceExport]) -> None:
    job.note_malformed(take)
    for name, export in exports.items():
        for what, count in export.left_out.items():
            job.note(f"{what} of {name} left out", amount=count)
        for note in export.notes:
            job.note(note)


class McapFile:
    """An MCAP file in chunks compressed by zstd. The end of the block writes its index.

    The file itself stays open. Its errors are raised by the next call, and at the end of the block. The
    ``profile`` of a bag of ROS 2 is "ros2".
    """

    def __init__(self, file: IO[bytes], profile: str = "") -> None:
        self.num_messages = 0
        self._waiting: list[tuple[int, Callable[..., None], bytes]] = []
        self._file = _WatchedFile(file)
        self._context = foxglove.Context()
        self._channels: dict[FoxgloveTopic, foxglove.Channel] = {}
        options = MCAPWriteOptions(compression=MCAPCompression.Zstd, profile=profile)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self._waiting.sort(key=itemgetter(0))
                self._write(len(self._waiting))
            self._writer.close()
        except Exception:
            if error is None and self._file.error is None:
                raise
        self._file.raise_error()  # in place of foxglove-sdk's own

    def add(self, messages: TopicMessages) -> None:
        """Take messages, which are written later, in the order of time."""
        log = self._channel(messages.topic).base.log  # the method of the class takes half as long again
        pairs = zip(messages.utimes, messages.messages, strict=True)
        self._waiting += [(utime, log, data) for utime, data in pairs]

    def write_most(self) -> None:
        """Write the messages, except those of the last seconds: earlier ones of other topics may follow."""
        self._waiting.sort(key=itemgetter(0))
        newest = self._waiting[-1][0] if self._waiting else 0
        self._write(bisect_left(self._waiting, newest - _MAX_LATE_US, key=itemgetter(0)))

    def _write(self, count: int) -> None:
        for utime, log, data in self._waiting[:count]:
            log(data, log_time=utime * 1000)
        del self._waiting[:count]
        self.num_messages += count
        self._file.raise_error()

    def _channel(self, topic: FoxgloveTopic) -> foxglove.Channel:
        channel = self._channels.get(topic)
        if channel is None:
            if len(self._channels) == _MAX_CHANNELS:
                raise TakeError(
                    "the labels in the take change so often that there would be more than "
                    f"{_MAX_CHANNELS} channels; choose a part by --from and --to"
                )
            schema = foxglove.Schema(
                name=topic.schema_name, encoding=topic.schema_encoding, data=topic.schema
            )
            channel = self._channels[topic] = foxglove.Channel(
                topic.name, schema=schema, message_encoding=topic.encoding, context=self._context
            )
        return channel

    def describe(self, source: TakeSource) -> None:
        """Add the server's XML whenever it was new, and a table of what the take says about a source."""
        newest, count = b"", 0
        for entry in source.parameters:
            if count and differ_in_statistics_only(newest, entry.xml):
                continue
            newest, count = entry.xml, count + 1
            time_ns = 1000 * min(max(entry.utime, 0), MAX_UTIME)
            self._writer.attach(
                log_time=time_ns,
                create_time=time_ns,
                name=f"{source.name}-parameters-{count}.xml",
                media_type="application/xml",
                data=newest,
            )
        details = {key: text for key, text in source.details._asdict().items() if text}
        about = {"server": source.server, "gateway_version": source.gateway_version, **details}
        self._writer.write_metadata(source.name, about)


class _WatchedFile:
    """A file whose errors foxglove-sdk would log only; ``error`` is the first one."""

    def __init__(self, file: IO[bytes]) -> None:
        self.error: BaseException | None = None
        self.write = self._watched(file.write)
        self.seek = self._watched(file.seek)
        self.flush = self._watched(file.flush)

    def _watched(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any) -> Any:
            try:
                return call(*arguments)
            except BaseException as error:
                self.error = self.error or error
                raise

        return watched

    def raise_error(self) -> None:
        """Raise the first error of the file, if there was one."""
        if self.error is not None:
            raise self.error
