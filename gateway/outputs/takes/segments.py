"""The last seconds of a source on the disk, in segments: event logs that are saved by links, or deleted."""

import contextlib
import errno
import logging
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from typing_extensions import override

from gateway.errors import QueryError, TakeError
from gateway.messages.history import FoundMessages, WantedMessages, sequence_of
from gateway.messages.take_names import default_name
from gateway.outputs.takes.folder import free_stem, is_full
from gateway.outputs.takes.segment_index import SegmentIndex, plan_reading, read_planned
from gateway.outputs.takes.take_file import SourceFacts, SourceWriter
from gateway.takes.files.description import NO_DETAILS, SourceDescription, TakeDetails
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import SUFFIX
from gateway.takes.files.take_writer import Messages, begin_log
from gateway.takes.files.writer_thread import LogFile

SEGMENT_S: Final = 10.0
"""How long a segment is, unless that would be more than MAX_SEGMENTS."""

MAX_SEGMENTS: Final = 360
_MAX_FILES: Final = 999
"""The maximum number of files of a saved take: they are numbered with three digits."""

_INCOMPLETE: Final = "takes: %s lacks %d messages, because their segments were removed or could not be linked"

logger = logging.getLogger(__name__)


@dataclass
class _Segment:
    """A segment that is complete. The times are on the monotonic clock."""

    path: Path
    begin_s: float
    end_s: float
    num_messages: int
    index: SegmentIndex


class Save:
    """A take that is being saved: a folder with a link to each segment.

    Segments are shared, so what the take is about and lacks is in a file of its own, the first one.
    """

    def __init__(self, folder: Path, description: SourceDescription) -> None:
        self.folder = folder
        self.name: str = folder.name
        """The name of the take."""
        self.num_files = 0
        self.num_lost = 0
        """How many messages were in segments that could not be linked."""
        self.lacks_present = False
        """Whether the present segment could not be linked; at its end, that is tried again."""
        self._description = description
        self._num_described = 0  # how many of the lost ones the first file has

    def link(self, segment: Path) -> None:
        """Add a segment. Raises OSError."""
        os.link(segment, self._path(self.num_files + 1))
        self.num_files += 1

    def describe(self) -> None:
        """Write the file that says what the take is about and lacks, if that is not said yet.

        Call it after the first segment. Raises OSError, TakeError.
        """
        is_described = self._path(0).exists() or self._description.details == NO_DETAILS
        if not self.num_files or (is_described and self.num_lost == self._num_described):
            return
        utime = next(EventLogReader(self._path(1)).events()).utime
        end = self._description.end(utime, self.num_lost)
        self._path(0).unlink(missing_ok=True)
        begin_log(self._path(0), [*self._description.beginning(self.name, utime), end]).close()
        self._num_described = self.num_lost

    def _path(self, number: int) -> Path:
        return self.folder / f"{self.name}-{number:03}{SUFFIX}"


class RollingSegments(SourceWriter):
    """Keeps the last ``keep_s`` seconds of a source, rounded up to whole segments, in ``folder``.

    Segments are on the same file system as the takes, so saving them is a matter of hard links. All methods
    are called in the thread that writes, except for ``kept_s`` and those that read.
    """

    def __init__(
        self,
        folder: Path,
        keep_s: float,
        facts: SourceFacts,
        monotonic: Callable[[], float],
    ) -> None:
        super().__init__(folder, facts)
        self._monotonic = monotonic
        self._keep_s = keep_s
        self._segments: deque[_Segment] = deque()
        self._log_began_s = 0.0
        self._num_in_log = 0  # how many messages the present log has
        self._num_segments = 0  # so far: no name is used twice
        self._saves: list[Save] = []
        self._written_s = 0.0  # when something was written before a problem of the disk
        self._index = SegmentIndex(folder)  # of the present segment
        self._newest: dict[bytes, int] = {}  # the number of the newest message on the disk, by channel
        self._indexing = threading.Lock()  # of the indices and of self._newest

    def kept_s(self) -> float:
        """Return how many seconds of the past could be saved now; a problem of the disk ends them."""
        end_s = self._written_s if self.disk.problem else self._monotonic()
        with contextlib.suppress(IndexError):  # the thread may take the last one
            return end_s - self._segments[0].begin_s
        return 0.0 if self._log is None else end_s - self._log_began_s

    def keep(self, keep_s: float) -> None:
        """Keep another number of seconds from now on."""
        self._keep_s = keep_s
        self._delete_expired()

    def paths(self) -> list[Path]:
        """Return the paths of all segments."""
        present = [] if self._log is None else [self._log.path]
        return [*(segment.path for segment in self._segments), *present]

    # Writing.

    def log_for(self, utime: int) -> LogFile:
        """See TakeWriter: begins another segment when it is time."""
        now_s = self._monotonic()
        if self._log is not None and (
            now_s - self._log_began_s >= max(SEGMENT_S, self._keep_s / MAX_SEGMENTS)
            or (not self._is_in_place and not self._log.is_in_place())
        ):
            self._end_segment()
        self._is_in_place = True
        if self._log is None:
            for folder in (self.path.parent, self.path):  # not those above: their disk may be missing
                folder.mkdir(exist_ok=True)
            name = f"{default_name(self.description.source)}-{self._num_segments:06}"
            self._log = self._begin_log(self.path / f"{name}{SUFFIX}", name, utime)
            self._index = SegmentIndex(self._log.path)
            self._num_segments += 1
            self._num_in_log = 0
            self._log_began_s = now_s
            for save in [*self._saves]:
                self._add_to_save(save)
        if not self.disk.problem:
            self._written_s = now_s
        return self._log

    @override
    def make_room(self, error: OSError) -> bool:
        return is_full(error) and self.delete_less_important()

    def delete_less_important(self) -> bool:
        """Delete what has expired, otherwise the oldest segment. Return False if there is none."""
        num_segments = len(self._segments)
        self._delete_expired()
        if self._segments and len(self._segments) == num_segments:
            self._delete_oldest()
        return bool(num_segments)

    def waits_for_room(self, error: OSError) -> bool:
        """Do not wait for room: what waits would hold up the running takes, and take their room later."""
        return not is_full(error)

    def _end_segment(self) -> None:
        log = self._close_log()
        if log is not None:
            for save in self._saves:
                if save.lacks_present:
                    save.lacks_present = False
                    try:
                        save.link(log.path)
                    except OSError:  # which is logged already
                        save.num_lost += self._num_in_log
            end_s = self._monotonic()
            segment = _Segment(log.path, self._log_began_s, end_s, self._num_in_log, self._index)
            with self._indexing:
                self._segments.append(segment)
                self._index = SegmentIndex(self.path)
            self._delete_expired()

    def _delete_expired(self) -> None:
        oldest_s = self._monotonic() - self._keep_s
        while self._segments and self._segments[0].end_s < oldest_s:
            self._delete_oldest()

    def _delete_oldest(self) -> None:
        with self._indexing:
            segment = self._segments.popleft()
        try:
            segment.path.unlink(missing_ok=True)
        except OSError as error:
            self.disk.failed(segment.path, error)

    def shorten(self) -> bool:
        """Delete the older half of the segments, to make room. Return False if there are none."""
        num_segments = len(self._segments)
        for _ in range(-(-num_segments // 2)):
            self._delete_oldest()
        return bool(num_segments)

    # Reading, in other threads.

    @override
    def written(self, begin: int, messages: Messages) -> None:
        assert self._log is not None  # noqa: S101 - it has the messages
        self._num_in_log += len(messages)
        newest = {channel: sequence_of(message) for channel, message in dict(messages).items()}
        with self._indexing:
            for channel in newest.keys() & self._newest.keys():
                if newest[channel] <= self._newest[channel]:  # the numbers have begun again
                    self._forget(channel)
            self._index.add(begin, self._log.num_bytes, messages)
            self._newest.update(newest)

    def forget(self, channel: bytes) -> None:
        """Do not find the messages of a channel again: another topic may get its name."""
        with self._indexing:
            self._forget(channel)

    def _forget(self, channel: bytes) -> None:
        self._newest.pop(channel, None)
        for index in self._indices():
            index.forget(channel)

    def _indices(self) -> list[SegmentIndex]:
        return [*(segment.index for segment in self._segments), self._index]

    def oldest(self, channel: bytes) -> tuple[int, int] | None:
        """Return number and time of the oldest message of a channel on the disk; None if it has none."""
        with self._indexing:
            found = (index.oldest(channel) for index in self._indices())
            return next((oldest for oldest in found if oldest is not None), None)

    def newest(self, channel: bytes) -> int:
        """Return the number of the newest message of a channel on the disk; -1 if it has none."""
        with self._indexing:
            return self._newest.get(channel, -1)

    def find(self, channel: bytes, wanted: WantedMessages) -> FoundMessages | None:
        """Read messages of a channel, as MessageHistory.find returns them; None if there are none."""
        oldest = self.oldest(channel)
        if oldest is None:
            return None
        with self._indexing:
            indices, newest = self._indices(), self._newest.get(channel, -1)
            plan = plan_reading(indices, channel, wanted, newest)
        messages, next_number = read_planned(plan, channel, wanted, self._monotonic)
        first = wanted.first
        if first is None:
            first = sequence_of(messages[0]) if messages else next_number
        return FoundMessages(messages, first, next_number - 1, oldest[0], newest)

    # Saving.

    def save(
        self,
        folder: Path,
        since_s: float,
        details: TakeDetails = NO_DETAILS,
        *,
        has_free_name: bool,
        goes_on: bool,
    ) -> Save:
        """Keep the segments since a time on the monotonic clock as a take in a new ``folder``.

        If it ``goes_on``, further segments are added until ``end_save``. Otherwise, the present segment ends
        now, so that the take does, too. Raises OSError, and QueryError if there is such a take already.
        """
        if self._log is not None and not self._log.is_in_place():
            self._end_segment()
        if self._log is None and not self._segments:
            raise QueryError("no messages are kept yet, so there is nothing to save", code="nothing-yet")
        description = replace(self.description, details=details)
        save = Save(free_stem(folder, has_free_name=has_free_name), description)
        save.folder.mkdir()
        try:
            self._link_segments(save, since_s)
            save.describe()
        except (OSError, TakeError):
            shutil.rmtree(save.folder, ignore_errors=True)
            raise
        self._saves.append(save)
        if not goes_on:
            self.end_save(save)
        elif save.num_lost:
            logger.warning(_INCOMPLETE, save.folder, save.num_lost)
        return save

    def _link_segments(self, save: Save, since_s: float) -> None:
        """Add all segments since a time to a new take. Raises OSError."""
        for segment in self._segments:
            if segment.end_s >= since_s:
                try:
                    save.link(segment.path)
                except FileNotFoundError:  # somebody has removed it
                    save.num_lost += segment.num_messages
        if self._log is not None:
            save.link(self._log.path)
        if not save.num_files:
            raise FileNotFoundError(errno.ENOENT, "somebody has removed the last seconds", str(self.path))

    def undo(self, saved: Future[Save]) -> None:
        """End and delete the take of a call of ``save``, unless that was cancelled or has failed."""
        if saved.cancelled() or saved.exception() is not None:
            return
        save = saved.result()
        if save in self._saves:
            self._saves.remove(save)
        shutil.rmtree(save.folder, ignore_errors=True)
        logger.warning(
            "takes: %s is deleted, because saving it took so long that its peer got an error", save.folder
        )

    def _add_to_save(self, save: Save) -> None:
        """Add the present segment to a take."""
        if self._log is None:
            return
        if save.num_files >= _MAX_FILES:
            self._saves.remove(save)
            logger.warning("takes: %s ends, because it has %d files", save.folder, _MAX_FILES)
            self._complete(save)
            return
        try:
            save.link(self._log.path)
        except OSError as error:
            save.lacks_present = True
            self.disk.failed(save.folder, error)

    def _complete(self, save: Save) -> None:
        """Note in a take what it lacks."""
        if save.num_lost:
            logger.warning(_INCOMPLETE, save.folder, save.num_lost)
        try:
            save.describe()
        except (OSError, TakeError) as error:
            logger.warning("takes: %s does not say what it lacks: %s", save.folder, error)

    def end_save(self, save: Save) -> None:
        """End a take here: the present segment ends."""
        if save in self._saves:
            self._end_segment()
            self._saves.remove(save)
            self._complete(save)

    def close(self) -> None:
        """End all takes, and delete the segments: what was saved stays."""
        self._end_segment()
        for save in self._saves:
            self._complete(save)
        self._saves.clear()
        while self._segments:
            self._delete_oldest()
        with contextlib.suppress(OSError):
            self.path.rmdir()
        self.disk.ended()
