"""The takes of one source: the states of each, and the way of the messages to their files.

============  =====================================  ================================================
what          begins                                 ends
============  =====================================  ================================================
``take``      ``start``: a peer starts it, or the    ``stop``, or at once if its file is not created
              server, which it follows               in time
``saves``     ``save``: a peer keeps the last        ``end_save``: after these seconds, or when the
              seconds, and some that are to come     segments end
``segments``  ``keep_segments``: takes.keep_last_s   ``end_segments``: other settings, or another
              says so                                folder
============  =====================================  ================================================

The end of the source or of the output ends all of them; a full folder ends takes and saves. Files are created
and ended in the thread that writes, in the order of these calls and of the messages between them.
"""

import asyncio
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from gateway.errors import QueryError, TakeError
from gateway.messages.history import FoundMessages, WantedMessages
from gateway.messages.host_time import now_utime
from gateway.messages.take_names import check_name, default_name
from gateway.messages.topics import Topic, lcm_channel, unique_name
from gateway.outputs.contract import ServerParameters
from gateway.outputs.takes.disk import Storage, disk_result
from gateway.outputs.takes.folder import ROLLING, StoredTake, TakePiece, add_c3d
from gateway.outputs.takes.newest_parameters import NewestParameters
from gateway.outputs.takes.publisher import TakesPublisher
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.take_file import SourceFacts, SourceWriter, TakeFile
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.runtime.losses import Losses
from gateway.takes.files.description import NO_DETAILS, SourceDescription, TakeDetails

MAX_SAVED_S: Final = 3600.0
"""The most seconds that one command saves, of the past and of the future."""

MAX_SAVES: Final = 16
"""How many takes of a source may be saved at a time, each with links to the same segments."""

C3D_WAIT_S: Final = 60.0
"""A C3D file that the server sends within this time after a take belongs to the take."""

logger = logging.getLogger(__name__)


class TakeList(NamedTuple):
    """The takes of a source, the newest first.

    ``running`` is the one that was started and not stopped yet, ``kept_s`` how many seconds the rolling
    segments hold, which ``save`` keeps.
    """

    running: StoredTake | None
    takes: Sequence[StoredTake]
    kept_s: float


class SourceTakes:
    """The takes of one source. Call it in the event loop; no call waits for the disk for long.

    Every method for peers raises QueryError: bad-request for a name, text or number that cannot be, a take
    that exists or is running already, or does not exist; nothing-yet if there is nothing to stop or save;
    disk if the folder cannot be used. The text is for the peer. On a full disk, ``delete_rolling`` deletes
    rolling segments of all sources.
    """

    def __init__(self, source: str, storage: Storage, delete_rolling: Callable[[], bool]) -> None:
        self.source = source
        self.storage = storage
        self._delete_rolling = delete_rolling
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
        self._publishers: list[TakesPublisher] = []
        self._parameters = NewestParameters(storage.host.thread("takes-parameters"), self._record_parameters)
        self._newest_take: tuple[Path, float] | None = None  # that has ended, and when

    # For peers.

    def announced(self) -> Self:
        """Return this source. Raises QueryError if the gateway does not have it, or not yet."""
        if not self.is_announced:
            raise QueryError(f"the gateway has no source {self.source!r}")
        return self

    def start(
        self, name: str = "", details: TakeDetails = NO_DETAILS, *, has_free_name: bool = False
    ) -> Coroutine[Any, Any, StoredTake]:
        """Start a take; everything that is published after this call is in it.

        "" means a name of source and time. With ``has_free_name``, a number is added to the name if there is
        such a take already. A source has one running take. The coroutine, which must be awaited, waits for
        the disk and returns the take.
        """
        writer, stem = self.storage.open_writer(), self._new_stem(name)
        if self.take is not None:
            raise QueryError(
                f"take {self.take.name!r} of source {self.source!r} is running already; stop it first"
            )
        take = TakeFile(
            stem,
            now_utime(),
            self._facts(details),
            has_free_name=has_free_name or not name,
            delete_less_important=self._delete_rolling,
        )
        created = writer.call(take.create)  # first, because what is recorded from now on follows it
        self.take = take
        self._update()

        async def begun() -> StoredTake:
            try:
                await disk_result(created, take.path, self.storage.disk)
            except QueryError:  # nobody waits for the file any more
                created.cancel()
                take.give_up()
                writer.call(take.discard)
                if self.take is take:
                    self.take = None
                    self._update()
                raise
            logger.info("takes: recording %s", take.path)
            return StoredTake(take.name, 0, take.utime, 0.0, is_running=True, details=details)

        return begun()

    def stop(self) -> Coroutine[Any, Any, StoredTake]:
        """End the running take.

        The coroutine, which must be awaited, returns it when everything is on the disk.
        """
        self.storage.started_writer()  # otherwise, it says why nothing is recorded
        take = self.take
        if take is None:
            raise QueryError(f"no take of source {self.source!r} is running", code="nothing-yet")
        completed = self._end_take(take)

        async def ended() -> StoredTake:
            await disk_result(completed, take.path, self.storage.disk)
            stored = await self.storage.read(partial(self.storage.folder.take_at, take.stem), take.path)
            size, lost = f"{stored.seconds:.1f} s, {stored.num_bytes / 1e6:.1f} MB", take.num_lost
            if lost or stored.is_cut_off:
                logger.warning("takes: %s is not complete: %s, %d messages lost", take.path, size, lost)
            else:
                logger.info("takes: %s is complete: %s", take.path, size)
            return stored._replace(num_lost=lost)

        return ended()

    async def save(
        self,
        last_s: float = math.inf,
        after_s: float = 0.0,
        name: str = "",
        details: TakeDetails = NO_DETAILS,
    ) -> StoredTake:
        """Keep the last ``last_s`` seconds as a take, which goes on for ``after_s`` seconds.

        Returns it at once; it is running until it is complete.
        """
        writer, stem = self.storage.open_writer(), self._new_stem(name)
        if not last_s > 0 or not 0 <= after_s <= MAX_SAVED_S:
            raise QueryError(
                f"expected last above 0 and after from 0 to {MAX_SAVED_S:g}, both in s; "
                f"found {last_s:g} and {after_s:g}"
            )
        segments = self.segments
        if segments is None:
            raise QueryError(
                "the gateway keeps no messages to save, because takes.keep_last_s is 0 in its configuration",
                code="nothing-yet",
            )
        if after_s > 0 and len(self.saves) >= MAX_SAVES:
            raise QueryError(
                f"{MAX_SAVES} takes of source {self.source!r} are being saved already; wait until one is "
                "complete",
                code="refused",
            )
        now_s = self.storage.host.monotonic()
        since_s = now_s - last_s
        call = partial(segments.save, stem, since_s, details, has_free_name=not name, goes_on=after_s > 0)
        saved = writer.call(call)
        try:
            save = await disk_result(saved, stem, self.storage.disk)
        except BaseException:  # nobody waits for it any more, or knows it
            saved.cancel()
            writer.call(partial(segments.undo, saved))
            raise
        if after_s > 0:
            loop = asyncio.get_running_loop()
            delay_s = max(0.0, now_s + after_s - self.storage.host.monotonic())
            self.saves[save] = loop.call_later(delay_s, self.end_save, save)
        else:
            self._note_end(save.folder)
        logger.info("takes: saving %s", save.folder)
        stored = partial(self.storage.folder.take_at, save.folder, is_running=after_s > 0)
        return await self.storage.read(stored, stem)

    async def list(self) -> TakeList:
        """Return the takes of the source."""
        folder, running = self.storage.folder, {path.name for path in self.running_paths}
        takes = await self.storage.read(partial(folder.takes, self.source, running), folder.directory)
        take = self.take
        current: StoredTake | None = None
        if take is not None:
            # Somebody may have removed its file; the next message begins another one.
            new = StoredTake(take.name, 0, take.utime, 0.0, details=take.description.details)
            stored = next((each for each in takes if each.name == take.name), new)
            current = stored._replace(is_running=True, is_cut_off=False, num_lost=take.num_lost)
            takes = [current if each.name == current.name else each for each in takes]
        kept_s = 0.0 if self.segments is None else self.segments.kept_s()
        return TakeList(current, takes, kept_s)

    async def read(self, name: str, offset: int) -> TakePiece:
        """Return up to MAX_PIECE_BYTES of a take; an empty piece at its end."""
        check_name(name)
        if offset < 0:
            raise QueryError(f"expected an offset of 0 or more; found {offset}")
        folder = self.storage.folder
        return await self.storage.read(partial(folder.read, self.source, name, offset), folder.directory)

    async def find(self, key: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages from the rolling segments (see Output.recorded_messages)."""
        segments, channel = self.segments, self._rolling_channel(key)
        if segments is None or channel is None:
            return None
        if wanted.last is None or wanted.last > segments.newest(channel):
            await self.storage.written()
        return await self.storage.read_history(partial(segments.find, channel, wanted))

    def oldest(self, key: str) -> tuple[int, int] | None:
        """Return number and time of the oldest message of a key in the rolling segments."""
        channel = self._rolling_channel(key)
        return None if self.segments is None or channel is None else self.segments.oldest(channel)

    def _rolling_channel(self, key: str) -> bytes | None:
        """Return the channel of a key in the rolling segments; None if it is not there."""
        channels = {} if self.segments is None else self.segments.channels
        found = (name for publisher, name in channels.items() if "/".join(publisher.topic.path) == key)
        return next((name.encode() for name in found), None)

    def _new_stem(self, name: str) -> Path:
        if name:
            check_name(name)
        return self.storage.folder.directory / self.source / (name or default_name(self.source))

    def _facts(self, details: TakeDetails = NO_DETAILS) -> SourceFacts:
        settings, server = self.storage.settings, self.storage.server(self.source)
        channels = lcm_channel(settings.prefix, self.source)
        description = SourceDescription(self.source, channels, server, details=details)
        disk, components = self.storage.disk, settings.components
        return SourceFacts(description, self._parameters.message, disk, self.losses, components)

    # The end, and the last seconds.

    def _end_take(self, take: TakeFile) -> Future[None]:
        """End the running take; the future is done when its file is complete."""
        self.take = None
        self._update()
        self._note_end(take.stem)
        take.give_up()
        return self._call(take.end)

    def end_save(self, save: Save) -> None:
        """End a take that is being saved."""
        timer = self.saves.pop(save, None)
        if timer is not None:
            timer.cancel()
        self._note_end(save.folder)
        if self.segments is not None:
            self._call(partial(self.segments.end_save, save))

    def _note_end(self, path: Path) -> None:
        self._newest_take = path, self.storage.host.monotonic()

    def end_takes(self) -> None:
        """End the running take, and those that are being saved."""
        if self.take is not None:
            self._end_take(self.take)
        for save in [*self.saves]:
            self.end_save(save)

    def keep_segments(self) -> None:
        """Begin rolling segments, if they are switched on and the output is open."""
        settings, writer = self.storage.settings, self.storage.writer
        if writer is None or self.storage.is_closed or not self.is_announced or not settings.keep_last_s:
            return
        folder = self.storage.folder.directory / ROLLING / self.source
        monotonic = self.storage.host.monotonic
        self.segments = RollingSegments(folder, settings.keep_last_s, self._facts(), monotonic)
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

    def _call(self, function: Callable[[], None]) -> Future[None]:
        """Call ``function`` in the thread that writes, after everything recorded so far was written."""
        assert self.storage.writer is not None  # noqa: S101 - something has begun, and is to be ended
        return self.storage.writer.call(function)

    @property
    def running_paths(self) -> set[Path]:
        """The paths, without extension, of the takes to which messages are added."""
        paths = {save.folder for save in self.saves}
        return paths if self.take is None else paths | {self.take.stem}

    def add_c3d(self, c3d_file: Path) -> None:
        """Link or copy a C3D file that arrives now beside the take to which it belongs, if there is one."""
        ended, ended_s = self._newest_take or (None, 0.0)
        if self.take is not None:
            path: Path | None = self.take.stem
        elif self.saves:
            path = [*self.saves][-1].folder
        else:
            path = ended if self.storage.host.monotonic() - ended_s <= C3D_WAIT_S else None
        if path is not None:
            self.storage.copy_thread.submit(partial(_add_c3d, path, c3d_file))

    # Messages.

    @property
    def _sinks(self) -> Sequence[SourceWriter]:
        return [sink for sink in (self.take, self.segments) if sink is not None]

    def publisher(self, topic: Topic) -> TakesPublisher:
        """Return a new publisher of ``topic``."""
        publisher = TakesPublisher(topic, self.storage.refusal, self.storage.queue_full, self._forget)
        self._publishers.append(publisher)
        self._set_targets(publisher)
        return publisher

    def _forget(self, publisher: TakesPublisher) -> None:
        if publisher in self._publishers:
            self._publishers.remove(publisher)
            for sink in self._sinks:
                channel = sink.channels.pop(publisher, None)
                if channel is not None and sink is self.segments:  # another topic may get this channel
                    self._call(partial(self.segments.forget, channel.encode()))

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
        publisher.set_targets(self.storage.writer, targets)

    def _update(self) -> None:
        for publisher in self._publishers:
            self._set_targets(publisher)
        self.on_wanted_changed()

    def publish_parameters(self, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Record parameters; returns a future if they have to be encoded before what follows them."""
        return self._parameters.publish(parameters)

    def _record_parameters(self, message: bytes) -> bool:
        """Record parameters in each file; return False if one has no room for them."""
        writer, is_recorded = self.storage.writer, True
        for sink in self._sinks:
            if writer is None or not writer.record(sink, sink.parameters_channel, message):
                is_recorded = False
        return is_recorded

    def maintain(self) -> None:
        """Record parameters that did not fit into the queue. Called once a second."""
        self._parameters.maintain()


def _add_c3d(take: Path, c3d_file: Path) -> None:
    try:
        path = add_c3d(take, c3d_file)
    except TakeError as error:
        logger.warning("takes: the C3D file of %s is not kept beside it: %s", take, error)
    else:
        logger.info("takes: %s is the C3D file of this take from the server", path)
