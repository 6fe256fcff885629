"""The takes of all sources: what peers ask for, and what the output records."""

import asyncio
import logging
import math
from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from gateway.errors import OutputError, QueryError, TakeError
from gateway.messages.host_time import now_utime
from gateway.messages.topics import lcm_channel
from gateway.outputs.takes.disk import Disk, FolderWatch, Host, disk_result
from gateway.outputs.takes.folder import ROLLING, StoredTake, TakePiece, TakesFolder, add_c3d
from gateway.outputs.takes.segments import RollingSegments
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.source_recording import SourceRecording
from gateway.outputs.takes.take_file import SourceFacts, TakeFile
from gateway.takes.files.description import NO_DETAILS, SourceDescription, TakeDetails
from gateway.takes.files.new_file import check_name, default_name
from gateway.takes.files.writer_thread import WriterThread

MAX_AFTER_S: Final = 3600.0
"""How long a take that is saved may go on."""

MAX_SAVES: Final = 16
"""How many takes of a source may be saved at a time, each with links to the same segments."""

_CLOSE_S: Final = 0.8
"""How long the end of the gateway waits for the disk."""

_Result = TypeVar("_Result")

logger = logging.getLogger(__name__)


class SourceTakes(NamedTuple):
    """The takes of a source, the newest first.

    ``running`` is the one that was started and not stopped yet, ``kept_s`` how many seconds the rolling
    segments hold, which ``save`` keeps.
    """

    running: StoredTake | None
    takes: Sequence[StoredTake]
    kept_s: float


class Takes:
    """The takes of all sources. Call it in the event loop; no call waits for the disk for long.

    Every method for peers raises QueryError: bad-request for a name, text or number that cannot be, a take
    that exists or is running already, or does not exist; nothing-yet if there is nothing to stop or save;
    disk if the folder cannot be used. The text is for the peer. ``server`` returns HOST:PORT of a source's
    server.
    """

    def __init__(self, settings: TakesSettings, max_queued_bytes: int, host: Host) -> None:
        self.settings = settings
        self.server: Callable[[str], str] = lambda _source: ""
        self.disk = Disk()
        self._max_queued_bytes = max_queued_bytes
        self._host = host
        self._watch = FolderWatch(settings, host)
        self._writer: WriterThread | None = None
        self._is_closed = False
        self._recordings: dict[str, SourceRecording] = {}
        self._read_thread = host.thread("takes-read")
        self._copy_thread = host.thread("takes-copy")

    @property
    def _folder(self) -> TakesFolder:
        return self._watch.folder

    # For peers.

    def start(
        self, source: str, name: str = "", details: TakeDetails = NO_DETAILS, *, has_free_name: bool = False
    ) -> Coroutine[Any, Any, StoredTake]:
        """Start a take; everything that is published after this call is in it.

        "" means a name of source and time. With ``has_free_name``, a number is added to the name if there is
        such a take already. A source has one running take. The coroutine, which must be awaited, waits for
        the disk and returns the take.
        """
        recording, writer = self._announced(source), self._open_writer()
        if name:
            check_name(name)
        if recording.take is not None:
            raise QueryError(
                f"take {recording.take.name!r} of source {source!r} is running already; stop it first"
            )
        take = TakeFile(
            self._folder.directory / source / (name or default_name(source)),
            now_utime(),
            self._facts(recording, details),
            has_free_name=has_free_name or not name,
            delete_less_important=self._delete_rolling,
        )
        created = recording.begin_take(writer, take)

        async def begun() -> StoredTake:
            try:
                await disk_result(created, take.path, self.disk)
            except QueryError:
                recording.cancel_take(take, created)
                raise
            logger.info("takes: recording %s", take.path)
            return StoredTake(take.name, 0, take.utime, 0.0, is_running=True, details=details)

        return begun()

    def _delete_rolling(self) -> bool:
        """Delete rolling segments, the oldest of each source, in the thread that writes."""
        rolling = [each.segments for each in [*self._recordings.values()] if each.segments is not None]
        return any([segments.delete_less_important() for segments in rolling])  # noqa: C419 - of every source

    def running(self, source: str) -> TakeFile | None:
        """Return the running take of a source."""
        recording = self._recordings.get(source)
        return None if recording is None else recording.take

    def stop(self, source: str) -> Coroutine[Any, Any, StoredTake]:
        """End the running take.

        The coroutine, which must be awaited, returns it when everything is on the disk.
        """
        recording = self._announced(source)
        self._started_writer()  # otherwise, it says why nothing is recorded
        take = recording.take
        if take is None:
            raise QueryError(f"no take of source {source!r} is running", code="nothing-yet")
        completed = recording.end_take()

        async def ended() -> StoredTake:
            await disk_result(completed, take.path, self.disk)
            stored = await self._read(partial(self._folder.take_at, take.stem), take.path)
            size, lost = f"{stored.seconds:.1f} s, {stored.num_bytes / 1e6:.1f} MB", take.num_lost
            if lost or stored.is_cut_off:
                logger.warning("takes: %s is not complete: %s, %d messages lost", take.path, size, lost)
            else:
                logger.info("takes: %s is complete: %s", take.path, size)
            return stored._replace(num_lost=lost)

        return ended()

    async def save(
        self,
        source: str,
        last_s: float = math.inf,
        after_s: float = 0.0,
        name: str = "",
        details: TakeDetails = NO_DETAILS,
    ) -> StoredTake:
        """Keep the last ``last_s`` seconds as a take, which goes on for ``after_s`` seconds.

        Returns it at once; it is running until it is complete.
        """
        recording, writer = self._announced(source), self._open_writer()
        if name:
            check_name(name)
        if not last_s > 0 or not 0 <= after_s <= MAX_AFTER_S:
            raise QueryError(
                f"expected last above 0 and after from 0 to {MAX_AFTER_S:g}, both in s; "
                f"found {last_s:g} and {after_s:g}"
            )
        segments = recording.segments
        if segments is None:
            raise QueryError(
                "the gateway keeps no messages to save, because takes.keep_last_s is 0 in its configuration",
                code="nothing-yet",
            )
        if after_s > 0 and len(recording.saves) >= MAX_SAVES:
            raise QueryError(
                f"{MAX_SAVES} takes of source {source!r} are being saved already; wait until one is complete",
                code="refused",
            )
        now_s = self._host.monotonic()
        folder = self._folder.directory / source / (name or default_name(source))
        since_s = now_s - last_s
        call = partial(segments.save, folder, since_s, details, has_free_name=not name, goes_on=after_s > 0)
        saved = writer.call(call)
        try:
            save = await disk_result(saved, folder, self.disk)
        except BaseException:  # nobody waits for it any more, or knows it
            saved.cancel()
            writer.call(partial(segments.undo, saved))
            raise
        if after_s > 0:
            loop = asyncio.get_running_loop()
            delay_s = max(0.0, now_s + after_s - self._host.monotonic())
            recording.saves[save] = loop.call_later(delay_s, recording.end_save, save)
        else:
            recording.ended(save.folder)
        logger.info("takes: saving %s", save.folder)
        stored = partial(self._folder.take_at, save.folder, is_running=after_s > 0)
        return await self._read(stored, folder)

    async def list(self, source: str) -> SourceTakes:
        """Return the takes of a source."""
        recording = self._announced(source)
        folder, running = self._folder, {path.name for path in recording.running_paths}
        takes = await self._read(partial(folder.takes, source, running), folder.directory)
        take = recording.take
        current: StoredTake | None = None
        if take is not None:
            stored = await self._read(partial(folder.take_at, take.stem, is_running=True), take.path)
            if recording.take is take:  # otherwise, it has just ended
                current = stored._replace(num_lost=take.num_lost)
                takes = [current if each.name == current.name else each for each in takes]
        kept_s = 0.0 if recording.segments is None else recording.segments.kept_s()
        return SourceTakes(current, takes, kept_s)

    async def read(self, source: str, name: str, offset: int) -> TakePiece:
        """Return up to MAX_PIECE_BYTES of a take; an empty piece at its end."""
        self._announced(source)
        check_name(name)
        if offset < 0:
            raise QueryError(f"expected an offset of 0 or more; found {offset}")
        return await self._read(partial(self._folder.read, source, name, offset), self._folder.directory)

    async def _read(self, call: Callable[[], _Result], path: Path) -> _Result:
        """Return the result of ``call``, which reads ``path`` in a thread. Raises QueryError."""
        return await disk_result(self._read_thread.submit(call), path)

    def _announced(self, source: str) -> SourceRecording:
        recording = self._recordings.get(source)
        if recording is None or not recording.is_announced:
            raise QueryError(f"the gateway has no source {source!r}")
        return recording

    def _started_writer(self) -> WriterThread:
        if self._writer is None or self._is_closed:
            raise QueryError(self.problem, code="disk")
        return self._writer

    def _open_writer(self) -> WriterThread:
        writer, problem = self._started_writer(), self.problem
        if problem and self._watch.is_checked:  # otherwise, creating the file shows it
            raise QueryError(problem, code="disk")
        return writer

    # Sources.

    def recording(self, source: str) -> SourceRecording:
        """Return the recording of a source, a new one the first time."""
        return self._recordings.setdefault(source, SourceRecording(source, self._host))

    def announce(self, source: str) -> None:
        """Accept takes of a source."""
        recording = self.recording(source)
        recording.is_announced = True
        self._keep(recording)

    def withdraw(self, source: str) -> None:
        """End everything that is recorded of a source, and accept no takes of it."""
        recording = self._recordings.pop(source, None)
        if recording is not None:
            recording.end()

    def _keep(self, recording: SourceRecording) -> None:
        """Begin rolling segments of a source if they are switched on."""
        writer = self._writer
        if writer is None or self._is_closed or not recording.is_announced or not self.settings.keep_last_s:
            return
        folder = self._folder.directory / ROLLING / recording.source
        facts, keep_s = self._facts(recording), self.settings.keep_last_s
        recording.keep(writer, RollingSegments(folder, keep_s, facts, self._host.monotonic))

    def _facts(self, recording: SourceRecording, details: TakeDetails = NO_DETAILS) -> SourceFacts:
        source, settings = recording.source, self.settings
        channels = lcm_channel(settings.prefix, source)
        description = SourceDescription(source, channels, self.server(source), details=details)
        return SourceFacts(
            description, recording.parameters, self.disk, recording.losses, settings.components
        )

    def add_c3d(self, source: str, c3d_file: Path) -> None:
        """Link or copy a C3D file beside the take to which it belongs, if there is one."""
        take = self.recording(source).take_of_c3d()
        if take is not None:
            self._copy_thread.submit(partial(_add_c3d, take, c3d_file))

    # The output.

    def open(self) -> None:
        """Start to write, and to check the folder."""
        if self._writer is not None or self._is_closed:
            return
        self._writer = writer = self._host.writer("takes", self._max_queued_bytes)
        writer.call(self._folder.recover)
        self._check_folder()
        for recording in self._recordings.values():
            self._keep(recording)

    @property
    def problem(self) -> str:
        """What is wrong and what to do; "" if takes can be recorded."""
        if self._is_closed:
            return "the output takes is closed; start the gateway again"
        if self._writer is None:
            return "the output takes is not open; start it first"
        return self._watch.problem or self.disk.problem

    async def written(self) -> None:
        """Wait until everything that was published so far is in the files."""
        await asyncio.wrap_future(self._started_writer().call(lambda: None))

    def refusal(self) -> OutputError | None:
        """Return the error for a message that is published while the output is not open."""
        problem = self.problem
        return OutputError(problem, cause="not open") if problem else None

    def queue_full(self) -> OutputError:
        """Return the error for a message that does not fit into the queue."""
        waiting_mib = self._max_queued_bytes / 2**20
        slow = (
            f"the disk of {self._folder.directory} is too slow: {waiting_mib:.0f} MiB wait for it; "
            "check what else writes to it"
        )
        return OutputError(self.problem or slow, cause="disk too slow")

    def maintain(self) -> None:
        """Check the folder and its limits. Called once a second."""
        for recording in self._recordings.values():
            recording.maintain()
        excess_bytes, self._watch.excess_bytes = self._watch.excess_bytes, 0
        if excess_bytes and self._writer is not None:
            self._end_because_full(self._writer, excess_bytes)
        self._check_folder()

    def _check_folder(self) -> None:
        if self._writer is not None and not self._is_closed:
            protected = {path for each in self._recordings.values() for path in each.running_paths}
            self._watch.check(self.settings, protected)

    def _end_because_full(self, writer: WriterThread, excess_bytes: int) -> None:
        limit = f"the folder {self._folder.directory} has {excess_bytes} bytes more than takes.max_bytes"
        recordings = [each for each in self._recordings.values() if each.running_paths]
        for recording in recordings:
            names = ", ".join(sorted(path.name for path in recording.running_paths))
            recording.losses.lost(
                "folder full",
                f"{names} ends, because {limit}, and no other take can be deleted; raise takes.max_bytes",
                frames=0,
            )
            recording.end_takes()
        if not recordings:
            for recording in self._recordings.values():
                if recording.segments is not None:
                    writer.call(recording.segments.shorten)

    def change(self, settings: TakesSettings) -> None:
        """Apply settings: limits at once, everything else to the next take and to the rolling segments."""
        before, self.settings = self.settings, settings
        if settings.effective_directory != before.effective_directory:
            old, self._watch = self._watch, FolderWatch(settings, self._host)
            old.close()
            self._check_folder()
        writer = self._writer
        if writer is None:
            return
        writer.call(self._folder.open)
        are_files_alike = all(
            getattr(settings, name) == getattr(before, name)
            for name in ("effective_directory", "prefix", "components")
        )
        for recording in self._recordings.values():
            segments = recording.segments
            if segments is not None and settings.keep_last_s and are_files_alike:
                writer.call(partial(segments.keep, settings.keep_last_s))
            elif segments is not None or settings.keep_last_s:
                recording.end_segments()
                self._keep(recording)

    def cancel_timers(self) -> None:
        """Forget when takes that are being saved would end, because the gateway stops."""
        for recording in self._recordings.values():
            for timer in recording.saves.values():
                timer.cancel()

    def close(self) -> None:
        """End all takes and wait for the disk, but not for long. Called in a thread."""
        if self._is_closed:
            return
        self._is_closed = True
        writer = self._writer
        if writer is not None:
            for recording in self._recordings.values():
                recording.end()
            if not writer.close(_CLOSE_S):
                logger.warning(
                    "takes: the disk of %s does not respond; %d bytes are not written",
                    *(self._folder.directory, writer.queued_bytes),
                )
                return
        self._watch.close()


def _add_c3d(take: Path, c3d_file: Path) -> None:
    try:
        path = add_c3d(take, c3d_file)
    except TakeError as error:
        logger.warning("takes: the C3D file of %s is not kept beside it: %s", take, error)
    else:
        logger.info("takes: %s is the C3D file of this take from the server", path)
