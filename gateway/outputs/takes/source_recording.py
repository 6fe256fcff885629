"""What is recorded of one source: the states of its takes, and the way of its messages to their files.

===========  ==============================  =====================================================
what         begins                          ends
===========  ==============================  =====================================================
``take``     ``begin_take``: a peer starts   ``end_take``: a peer or the server stops it; or
             it, or the server, which it     ``cancel_take``: its file was not created in time
             follows
``saves``    a peer saves the last seconds   ``end_save``: after these seconds, or when the segments
             and some that are still to      end
             come
``segments`` ``keep``: keep_last_s says so   ``end_segments``: other settings, or another folder
===========  ==============================  =====================================================

The end of the source or of the output ends all of them; a full folder ends takes and saves. Files are created
and ended in the thread that writes, in the order of these calls and of the messages between them.
"""

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Final

from gateway.errors import OutputError
from gateway.logs.losses import Losses
from gateway.messages.host_time import now_utime
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.contract import ServerParameters
from gateway.outputs.parameters_message import encode_parameters, published_again
from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.publisher import TakesPublisher
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.take_file import SourceWriter, TakeFile
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.takes.files.writer_thread import WriterThread

C3D_WAIT_S: Final = 60.0
"""A C3D file that the server sends within this time after a take belongs to the take."""

_LONG_XML_BYTES: Final = 32 * 1024
"""Longer parameters are encoded by a thread: 16 MB take 30 ms."""

logger = logging.getLogger(__name__)


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
        self._num_parameters = 0
        self._long_parameters: Future[bytes] | None = None  # that are being encoded
        self._encoder = host.thread("takes-parameters")
        self._are_parameters_missing = False
        self._newest_take: tuple[Path, float] | None = None  # that has ended, and when

    # Takes.

    def begin_take(self, writer: WriterThread, take: TakeFile) -> Future[None]:
        """Record everything from now on in a take, too; the future is done when its file exists."""
        created = writer.call(take.create)  # first, because what is recorded from now on follows it
        self._writer, self.take = writer, take
        self._update()
        return created

    def cancel_take(self, take: TakeFile, created: Future[None]) -> None:
        """Undo ``begin_take``, which returned ``created``, because nobody waits for the file any more."""
        created.cancel()
        take.give_up()
        self._call(take.discard)
        if self.take is take:
            self.take = None
            self._update()

    def end_take(self) -> Future[None]:
        """End the running take; the future is done when its file is complete."""
        take, self.take = self.take, None
        assert take is not None  # noqa: S101 - the caller has found it
        self._update()
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
            self.end_take()
        for save in [*self.saves]:
            self.end_save(save)

    def keep(self, writer: WriterThread, segments: RollingSegments) -> None:
        """Record everything from now on in rolling segments, too."""
        self._writer, self.segments = writer, segments
        self._update()

    def end_segments(self) -> None:
        """End the rolling segments, and the takes that are being saved from them."""
        for save in [*self.saves]:
            self.end_save(save)
        segments, self.segments = self.segments, None
        if segments is not None:
            self._update()
            segments.give_up()
            self._call(segments.close)

    def end(self) -> None:
        """End everything that is recorded."""
        self.end_takes()
        self.end_segments()

    @property
    def running_paths(self) -> set[Path]:
        """The paths, without extension, of the takes to which messages are added."""
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

    def _call(self, function: Callable[[], None]) -> Future[None]:
        """Call ``function`` in the thread that writes, after everything recorded so far was written."""
        assert self._writer is not None  # noqa: S101 - something has begun, and is to be ended
        return self._writer.call(function)

    # Messages.

    @property
    def _sinks(self) -> list[SourceWriter]:
        return [sink for sink in (self.take, self.segments) if sink is not None]

    def publisher(
        self, topic: Topic, refusal: Callable[[], OutputError | None], full: Callable[[], OutputError]
    ) -> TakesPublisher:
        """Return a new publisher of ``topic``."""
        publisher = TakesPublisher(topic, refusal, full, self._forget)
        self._publishers.append(publisher)
        self._set_targets(publisher)
        return publisher

    def _forget(self, publisher: TakesPublisher) -> None:
        if publisher in self._publishers:
            self._publishers.remove(publisher)
            for sink in self._sinks:
                sink.channels.pop(publisher, None)

    def _set_targets(self, publisher: TakesPublisher) -> None:
        """Give a publisher a channel of its own in each file, unless its component is not recorded there."""
        path, targets = publisher.topic.path, []
        component = COMPONENTS_BY_KEY.get(path[0]) if len(path) == 1 else None
        for sink in self._sinks:
            if component is None or component in sink.components:
                if publisher not in sink.channels:
                    name = lcm_channel(sink.description.channels, *path)
                    sink.channels[publisher] = unique_name(name, sink.channels.values())
                targets.append((sink, sink.channels[publisher].encode()))
        publisher.set_targets(self._writer, targets)

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
        for sink in self._sinks:
            if self._writer is None or not self._writer.record(sink, sink.parameters_channel, message):
                self._are_parameters_missing = True

    def maintain(self) -> None:
        """Record parameters that did not fit into the queue. Called once a second."""
        if self._are_parameters_missing and self.parameters is not None:
            self._record_parameters(self.parameters)
