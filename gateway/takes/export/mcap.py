"""Export to MCAP with Foxglove's types, for Foxglove, Lichtblick and rerun.

The file is written while the take is read, so its size does not matter.
"""

import bisect
import logging
import struct
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import IO, Any, Final, Self

import foxglove
import numpy as np
from foxglove.mcap import MCAPCompression, MCAPWriteOptions

from gateway.errors import ProtocolError, TakeError
from gateway.foxglove_schemas.messages import FoxgloveSource
from gateway.foxglove_schemas.topics import MAX_FIELDS, MAX_UTIME, FloatTopics, FoxgloveMessage, Topic
from gateway.messages.decode import decode
from gateway.messages.encode import ITEMS_OFFSET, metres_per_unit
from gateway.messages.texts import xml_bytes
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ITEM_DTYPES, ComponentType
from gateway.rtc3d.parameters import Parameters, differ_in_statistics_only
from gateway.takes.export.job import ExportJob, nothing_to_export
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.take import Take, TakeSource

_MAX_CHANNELS: Final = 1000
"""More can only come from labels that change all the time."""

# foxglove-sdk logs errors of the file, which McapFile raises. Without a handler, they would go to stderr.
logging.getLogger("foxglove").addHandler(logging.NullHandler())


_HEAD: Final = struct.Struct(">8xqq8x4xi4xqi")
"""Of a component's message: utime, capture_utime, version of the parameters, time stamp, number of items."""

_EVENT_HEADER_BYTES: Final = 50  # about, with the channel
_PROGRESS_BYTES: Final = 1024 * 1024
_MAX_CONVERTERS: Final = 100
_NO_PARAMETERS: Final = -1
_NUMBERS: Final = (ComponentType.ANALOG, ComponentType.FORCE)
"""The components whose messages have a field for each number."""


def export_mcap(job: ExportJob) -> None:
    """Write the sources of a take to one file, each with topics of its own, and all their parameters."""
    take = job.open_take(components=())
    job.note_malformed(take)
    note_metres(job, take)
    sources = {name: _SourceExport(source) for name, source in take.sources.items()}
    reader = TakeReader(job.take)
    total = sum(log.path.stat().st_size for log in reader.logs)
    first, stop = job.utimes(take)
    done = shown = 0
    with McapFile(job.files.create(job.out)) as file:
        for utime, name, key, message in reader.messages():
            done += len(message) + _EVENT_HEADER_BYTES
            if done - shown >= _PROGRESS_BYTES:
                shown = done
                job.progress(f"writing {job.out.name}", min(done, total), total)
            if name in sources and key == "parameters":
                sources[name].attach_parameters(message, file)
            elif name in sources and key in COMPONENTS_BY_KEY and first <= utime < stop:
                sources[name].write(key, message, file)
        job.progress(f"writing {job.out.name}", total, total)
        for source in take.sources.values():
            file.write_metadata(source)
    if not file.num_messages:
        raise nothing_to_export(job, "frames")
    for name, exported in sources.items():
        for what, count in exported.left_out.items():
            job.note(f"{what} of {name} left out", amount=count)
        for what in exported.remarks:
            job.note(what)


def note_metres(job: ExportJob, take: Take) -> None:
    """Report that positions are converted to m."""
    for source in take.sources.values():
        for _, _, parameters in source.parameters:
            unit = parameters.length_unit
            if (parameters.markers or parameters.tools) and metres_per_unit(unit) not in {None, 1.0}:
                job.note(f"positions converted from {unit} to m")


class _SourceExport:
    """One source of a take on its way to a file."""

    def __init__(self, source: TakeSource) -> None:
        self.left_out: Counter[str] = Counter()
        """How many messages were left out, by what they are."""
        self.remarks: dict[str, None] = {}
        """What was changed, and what the parameters lack."""
        self._name = source.name
        self._entries = source.parameters
        self._by_version: dict[int, list[int]] = {}  # indices of parameters, in the order of their times
        for index in sorted(range(len(self._entries)), key=lambda index: self._entries[index].utime):
            self._by_version.setdefault(self._entries[index].version, []).append(index)
        self._topics = FloatTopics(source.name)
        self._converters: dict[int, FoxgloveSource] = {}  # by the index of the parameters
        self._xml = b""  # of the newest attachment
        self._num_attached = 0

    def write(self, key: str, message: bytes, file: "McapFile") -> None:
        """Write the message of a component."""
        component = COMPONENTS_BY_KEY[key]
        dtype = ITEM_DTYPES[component]
        utime, capture_utime, version, timestamp_us, num_items = (
            _HEAD.unpack_from(message) if len(message) >= ITEMS_OFFSET else (0, 0, 0, 0, -1)
        )
        if num_items < 0 or len(message) != ITEMS_OFFSET + num_items * dtype.itemsize:
            self.left_out[f"malformed messages of {key}"] += 1
        elif not 0 <= capture_utime <= MAX_UTIME:
            self.left_out[f"messages from before 1970 or after 2106 in {key}"] += 1
        elif component in _NUMBERS and (len(message) - ITEMS_OFFSET) // 4 > MAX_FIELDS:
            self.left_out[f"messages with more than {MAX_FIELDS} numbers in {key}"] += 1
        else:
            converter = self._converter(version, utime, capture_utime, file)
            items = np.frombuffer(message, dtype, num_items, ITEMS_OFFSET)
            for converted in converter.convert(component, items, capture_utime, timestamp_us):
                file.write(converted)

    def attach_parameters(self, message: bytes, file: "McapFile") -> None:
        """Attach the server's XML if it is new."""
        try:
            decoded = decode(message)
        except ProtocolError:
            return  # open_take has counted it
        xml = xml_bytes(decoded.xml)
        if self._num_attached and differ_in_statistics_only(self._xml, xml):
            return
        self._xml = xml
        self._num_attached += 1
        utime = min(max(decoded.utime, 0), MAX_UTIME)
        file.attach(utime, f"{self._name}-parameters-{self._num_attached}.xml", "application/xml", xml)

    def _converter(self, version: int, utime: int, capture_utime: int, file: "McapFile") -> FoxgloveSource:
        """Return the converter for a message; describe the source before its first message.

        The parameters are those that ``Series.parameters_of`` would return.
        """
        indices = self._by_version.get(version) or [_NO_PARAMETERS]
        index = indices[0]
        if len(indices) > 1:
            older = bisect.bisect_right(indices, utime, key=lambda index: self._entries[index].utime)
            index = indices[max(older - 1, 0)]
        found = self._converters.get(index)
        if found is None:
            parameters = Parameters() if index == _NO_PARAMETERS else self._entries[index].parameters
            if len(self._converters) == _MAX_CONVERTERS:
                self._converters.clear()
            found = self._converters[index] = FoxgloveSource(self._topics, parameters, version)
            if found.problem:
                self.remarks[f"{self._name}: {found.problem}"] = None
            for key in found.changed_names:
                self.remarks[f"labels of {key} changed to names of fields"] = None
            for message in found.describe(capture_utime):
                file.write(message)
        return found


class McapFile:
    """An MCAP file in chunks compressed by zstd. The end of the block writes its index.

    The file itself stays open. Its errors are raised by the next call, and at the end of the block. The
    ``profile`` of a bag of ROS 2 is "ros2".
    """

    def __init__(self, file: IO[bytes], profile: str = "") -> None:
        self.num_messages = 0
        self._file = _WatchedFile(file)
        self._context = foxglove.Context()
        self._channels: dict[Topic, foxglove.Channel] = {}
        options = MCAPWriteOptions(compression=MCAPCompression.Zstd, profile=profile)
        self._writer = foxglove.open_mcap(self._file, context=self._context, writer_options=options)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
        except Exception:
            if error is None and self._file.error is None:
                raise
        self._file.raise_error()  # in place of foxglove-sdk's own

    def write(self, message: FoxgloveMessage) -> None:
        """Append a message."""
        topic = message.topic
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
        channel.log(message.data, log_time=message.utime * 1000)
        self.num_messages += 1
        self._file.raise_error()

    def write_metadata(self, source: TakeSource) -> None:
        """Add a table with the server of a source, and what the take says about it."""
        details = {key: text for key, text in source.details._asdict().items() if text}
        about = {"server": source.server, "gateway_version": source.gateway_version, **details}
        self._writer.write_metadata(source.name, about)

    def attach(self, utime: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file in the file. ``utime`` is its time in µs since 1970."""
        self._writer.attach(
            log_time=utime * 1000, create_time=utime * 1000, name=name, media_type=media_type, data=data
        )


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
