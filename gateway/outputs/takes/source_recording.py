"""What is recorded of one source: its publishers, its running take, its rolling segments, its parameters."""

import asyncio
import logging
from collections.abc import Callable, Collection
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Final

from gateway.errors import OutputError
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.contract import ServerParameters, encode_parameters, published_again
from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.publisher import TakesPublisher
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.take_file import SourceWriter, TakeFile
from gateway.rtc3d.components import COMPONENTS_BY_KEY, ComponentType
from gateway.takes.files.writer_thread import WriterThread

C3D_WAIT_S: Final = 60.0
"""A C3D file that the server sends within this time after a take belongs to the take."""

_LONG_XML_BYTES: Final = 32 * 1024
"""Longer parameters are encoded by a thread: 16 MB take 30 ms."""

logger = logging.getLogger(__name__)


class _Files:
    """A sink to which messages of the source go, and the channels of the publishers in its files."""

    def __init__(self, sink: SourceWriter, components: Collection[ComponentType]) -> None:
        self.sink = sink
        self._components = components
        self._channels: dict[TakesPublisher, str] = {}

    def add(self, publisher: TakesPublisher) -> None:
        """Give a publisher a channel of its own, unless its component is not recorded."""
        topic = publisher.topic
        component = COMPONENTS_BY_KEY.get(topic.path[0])
        if len(topic.path) == 1 and component is not None and component not in self._components:
            return
        name = lcm_channel(self.sink.description.channels, *topic.path)
        self._channels[publisher] = unique_name(name, self._channels.values())

    def remove(self, publisher: TakesPublisher) -> None:
        """Free the channel of a publisher."""
        self._channels.pop(publisher, None)

    def channel(self, publisher: TakesPublisher) -> bytes | None:
        """Return the channel of a publisher, None if it is not recorded."""
        name = self._channels.get(publisher)
        return None if name is None else name.encode()


class SourceRecording:
    """The recording of one source. Call it in the event loop."""

    def __init__(self, source: str, host: Host) -> None:
        self.source = source
        self._monotonic = host.monotonic
        self.losses = Losses(logger, source)
        """Where losses are counted."""
        self.on_wanted_changed: Callable[[], None] = lambda: None
        """Called when messages are recorded that were not before, or the other way round."""
        self.is_announced = False
        self.take: TakeFile | None = None
        """The running take."""
        self.segments: RollingSegments | None = None
        self.saves: dict[Save, asyncio.TimerHandle] = {}
        """The takes that are being saved, and what will end them."""
        self.parameters: bytes | None = None
        """The newest ``parameters_t``."""
        self._writer: WriterThread | None = None
        self._publishers: list[TakesPublisher] = []
        self._files: list[_Files] = []
        self._num_parameters = 0
        self._long_parameters: Future[bytes] | None = None  # that are being encoded
        self._encoder = host.thread("takes-parameters")
        self._are_parameters_missing = False
        self._newest_take: tuple[Path, float] | None = None  # that has ended, and when

    # Publishers and files.

    def publisher(
        self, topic: Topic, refusal: Callable[[], OutputError | None], full: Callable[[], OutputError]
    ) -> TakesPublisher:
        """Return a new publisher of ``topic``."""
        publisher = TakesPublisher(topic, refusal, full, self._forget)
        self._publishers.append(publisher)
        for files in self._files:
            files.add(publisher)
        self._set_targets(publisher)
        return publisher

    def _forget(self, publisher: TakesPublisher) -> None:
        if publisher in self._publishers:
            self._publishers.remove(publisher)
            for files in self._files:
                files.remove(publisher)

    def _set_targets(self, publisher: TakesPublisher) -> None:
        targets = [
            (files.sink, channel)
            for files in self._files
            if (channel := files.channel(publisher)) is not None
        ]
        publisher.set_targets(self._writer, targets)

    def add(
        self,
        writer: WriterThread,
        sink: SourceWriter,
        components: Collection[ComponentType],
        *,
        is_first: bool = False,
    ) -> None:
        """Record everything from now on in ``sink``, too, and before the others if it ``is_first``."""
        self._writer = writer
        files = _Files(sink, components)
        for publisher in self._publishers:
            files.add(publisher)
        self._files.insert(0 if is_first else len(self._files), files)
        self._update()

    def remove(self, sink: SourceWriter) -> None:
        """Record nothing in ``sink`` from now on."""
        self._files = [files for files in self._files if files.sink is not sink]
        self._update()

    def _update(self) -> None:
        for publisher in self._publishers:
            self._set_targets(publisher)
        self.on_wanted_changed()

    # Parameters.

    def publish_parameters(self, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Record parameters; returns a future if they have to be encoded before what follows them."""
        utime, sequence = now_utime(), self._num_parameters
        self._num_parameters += 1
        encode = partial(encode_parameters, parameters, utime=utime, arrived_utime=utime, sequence=sequence)
        if self._long_parameters is None and len(parameters.xml) <= _LONG_XML_BYTES:
            self._record_parameters(encode())
            return None
        self._long_parameters = encoded = self._encoder.submit(encode)
        return asyncio.ensure_future(self._record_when_encoded(encoded))

    async def _record_when_encoded(self, encoded: Future[bytes]) -> None:
        message = await asyncio.wrap_future(encoded)
        if self._long_parameters is encoded:
            self._long_parameters = None
        self._record_parameters(published_again(message, now_utime()))

    def _record_parameters(self, message: bytes) -> None:
        self.parameters = message
        self._are_parameters_missing = False
        for files in self._files:
            self._record_in(files.sink, message)

    def _record_in(self, sink: SourceWriter, message: bytes) -> None:
        writer = self._writer
        if writer is not None and not writer.record(sink, sink.parameters_channel, message):
            self._are_parameters_missing = True

    def maintain(self) -> None:
        """Record parameters that did not fit into the queue. Called once a second."""
        if self._are_parameters_missing and self.parameters is not None:
            self._record_parameters(self.parameters)

    # Takes.

    @property
    def running_names(self) -> set[str]:
        """The names of the takes to which messages are added."""
        names = {save.name for save in self.saves}
        return names if self.take is None else names | {self.take.name}

    @property
    def running_paths(self) -> set[Path]:
        """The paths of these takes, without the extension."""
        paths = {save.folder for save in self.saves}
        return paths if self.take is None else paths | {self.take.stem}

    def ended(self, path: Path) -> None:
        """Remember a take that ends now."""
        self._newest_take = path, self._monotonic()

    def take_of_c3d(self) -> Path | None:
        """Return the path of the take to which a C3D file belongs that arrives now."""
        if self.take is not None:
            return self.take.stem
        for save in reversed(self.saves):
            return save.folder
        if self._newest_take is not None and self._monotonic() - self._newest_take[1] <= C3D_WAIT_S:
            return self._newest_take[0]
        return None

    def detach(self, take: TakeFile) -> None:
        """Record nothing in a take from now on."""
        self.remove(take)
        if self.take is take:
            self.take = None

    def end_take(self, take: TakeFile) -> Future[None]:
        """End a take; the future is done when its file is complete."""
        self.detach(take)
        self.ended(take.stem)
        take.give_up()
        return self._call(take.end)

    def end_save(self, save: Save) -> None:
        """End a take that is being saved."""
        timer = self.saves.pop(save, None)
        if timer is not None:
            timer.cancel()
        self.ended(save.folder)
        if self.segments is not None:
            self._call(partial(self.segments.end_save, save))

    def end_takes(self) -> None:
        """End the running take, and those that are being saved."""
        if self.take is not None:
            self.end_take(self.take)
        for save in [*self.saves]:
            self.end_save(save)

    def end_segments(self) -> None:
        """End the rolling segments, and the takes that are being saved from them."""
        for save in [*self.saves]:
            self.end_save(save)
        segments, self.segments = self.segments, None
        if segments is not None:
            self.remove(segments)
            segments.give_up()
            self._call(segments.close)

    def end(self) -> None:
        """End everything that is recorded."""
        self.end_takes()
        self.end_segments()

    def _call(self, function: Callable[[], None]) -> Future[None]:
        """Call ``function`` in the thread that writes, after everything recorded so far was written."""
        assert self._writer is not None  # noqa: S101 - something was added, and is to be ended
        return self._writer.call(function)
