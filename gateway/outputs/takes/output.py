"""The output that records takes on this computer, where nothing can be lost on the way."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from gateway.messages.history import FoundMessages, WantedMessages
from gateway.messages.topics import Topic
from gateway.outputs.contract import (
    Command,
    Output,
    OutputHealth,
    Publisher,
    QueryService,
    ServerFile,
    ServerParameters,
)
from gateway.outputs.takes.control import TakeCommand
from gateway.outputs.takes.disk import FolderWatch, Host, Storage
from gateway.outputs.takes.follow import EventPublisher, TakeFollower
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.source_takes import SourceTakes
from gateway.rtc3d.components import ComponentType
from gateway.runtime.losses import Losses
from gateway.takes.files.writer_thread import MAX_QUEUED_BYTES, WriterThread

_CLOSE_S: Final = 0.8
"""How long the end of the gateway waits for the disk."""

logger = logging.getLogger(__name__)


class TakesOutput(Output):
    """Records messages in files, while a take is running and for the rolling segments."""

    name = "takes"
    drop_causes = ("disk too slow", "not written", "folder full")

    def __init__(
        self, settings: TakesSettings, max_queued_bytes: int = MAX_QUEUED_BYTES, host: Host | None = None
    ) -> None:
        self.has_tool_poses = settings.tool_poses
        self.storage = Storage(settings, max_queued_bytes, host or Host())
        """What all sources share."""
        self._sources: dict[str, SourceTakes] = {}
        self._followers: dict[str, TakeFollower] = {}  # by source
        self._command = TakeCommand(self.takes, self.storage.host.monotonic)

    def takes(self, source: str) -> SourceTakes:
        """Return the takes of a source. Raises QueryError if the gateway does not have it."""
        return (self._sources.get(source) or self._new_source(source)).announced()

    def source(self, source: str) -> SourceTakes:
        """Return the takes of a source, new ones the first time."""
        if source not in self._sources:
            self._sources[source] = self._new_source(source)
        return self._sources[source]

    def _new_source(self, source: str) -> SourceTakes:
        return SourceTakes(source, self.storage, self._delete_rolling)

    def _delete_rolling(self) -> bool:
        """Delete rolling segments, the oldest of each source, in the thread that writes."""
        rolling = [each.segments for each in [*self._sources.values()] if each.segments is not None]
        return any([segments.delete_less_important() for segments in rolling])  # noqa: C419 - of every source

    def start(self) -> None:
        """Start to check the folder and to write."""
        if self.storage.writer is None and not self.storage.is_closed:
            self.storage.open()
            self._check_folder()
            for source in self._sources.values():
                source.keep_segments()

    def publisher(self, topic: Topic) -> Publisher:
        """Return a new publisher of ``topic``, under a channel as on LCM."""
        publisher = self.source(topic.source).publisher(topic)
        if topic.path == (ComponentType.EVENT.key,):
            return EventPublisher(publisher, self._follower(topic.source))
        return publisher

    def _follower(self, source: str) -> TakeFollower:
        if source not in self._followers:
            self._followers[source] = TakeFollower(self.source(source), self.storage.host.monotonic)
        return self._followers[source]

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Messages are wanted while a take is running or the last seconds are kept."""
        self.source(source).on_wanted_changed = on_change
        return True

    def health(self) -> OutputHealth:
        """Return whether takes can be recorded."""
        problem = self.storage.problem
        return OutputHealth(not problem, problem)

    def maintain(self) -> None:
        """Check the folder and its limits, and whether measurements have ended."""
        for source in self._sources.values():
            source.maintain()
        excess_bytes, self.storage.watch.excess_bytes = self.storage.watch.excess_bytes, 0
        if excess_bytes and self.storage.writer is not None:
            self._end_because_full(self.storage.writer, excess_bytes)
        self._check_folder()
        self._recover()
        for follower in self._followers.values():
            follower.maintain()

    def _check_folder(self) -> None:
        if self.storage.writer is not None and not self.storage.is_closed:
            protected = {path for each in self._sources.values() for path in each.running_paths}
            self.storage.watch.check(self.storage.settings, protected)

    def _recover(self) -> None:
        """Keep what a killed gateway has left on a disk that was mounted after the start."""
        writer, folder = self.storage.writer, self.storage.folder
        if writer is not None and not self.storage.is_closed and folder.needs_recovery:
            folder.needs_recovery = False
            writer.call(lambda: folder.recover(self._own_segments()))

    def _own_segments(self) -> set[Path]:
        """Return the paths of the rolling segments, in the thread that writes."""
        sources = [*self._sources.values()]
        return {path for each in sources if each.segments is not None for path in each.segments.paths()}

    def _end_because_full(self, writer: WriterThread, excess_bytes: int) -> None:
        directory = self.storage.folder.directory
        limit = f"the folder {directory} has {excess_bytes} bytes more than takes.max_bytes"
        recording = [each for each in self._sources.values() if each.running_paths]
        for source in recording:
            names = ", ".join(sorted(path.name for path in source.running_paths))
            source.losses.lost(
                "folder full",
                f"{names} ends, because {limit}, and no other take can be deleted; raise takes.max_bytes",
                frames=0,
            )
            source.end_takes()
        if not recording:
            for source in self._sources.values():
                if source.segments is not None:
                    writer.call(source.segments.shorten)

    def is_configured_like(self, other: Output) -> bool:
        """Any settings can be taken over."""
        return isinstance(other, TakesOutput)

    def take_over(self, other: Output) -> bool:
        """Apply other settings: limits at once, everything else to the next take and to the segments."""
        assert isinstance(other, TakesOutput)  # noqa: S101 - is_configured_like says so
        before, settings = self.storage.settings, other.storage.settings
        if settings == before:
            return False
        self.has_tool_poses = other.has_tool_poses
        self.storage.settings = settings
        if settings.effective_directory != before.effective_directory:
            old, self.storage.watch = self.storage.watch, FolderWatch(settings, self.storage.host)
            old.close()
            self._check_folder()
        writer = self.storage.writer
        if writer is None:
            return True
        writer.call(self.storage.folder.open)
        are_files_alike = all(
            getattr(settings, name) == getattr(before, name)
            for name in ("effective_directory", "prefix", "components")
        )
        for source in self._sources.values():
            segments = source.segments
            if segments is not None and settings.keep_last_s and are_files_alike:
                writer.call(partial(segments.keep, settings.keep_last_s))
            elif segments is not None or settings.keep_last_s:
                source.end_segments()
                source.keep_segments()
        return True

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what the disk does not accept."""
        self.source(source).losses = losses

    def announce(self, source: str) -> None:
        """Accept takes of ``source``."""
        self.source(source).is_announced = True
        self.source(source).keep_segments()

    def withdraw(self, source: str) -> None:
        """End what is recorded of ``source``, and accept no takes of it."""
        takes = self._sources.pop(source, None)
        if takes is not None:
            takes.is_announced = False
            takes.end()
        self._followers.pop(source, None)

    def show_measurement(self, source: str, is_running: bool | None) -> None:
        """Start a take with a measurement, if the settings say so."""
        self._follower(source).show_measurement(is_running)

    async def follow_recording(self, source: str, *, start: bool, name: str) -> Mapping[str, Any]:
        """Start and stop a take with a recording, if the settings say so."""
        return await self._follower(source).follow_recording(start=start, name=name)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Record the parameters now and at the beginning of each file."""
        return self.source(source).publish_parameters(parameters)

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Link or copy the C3D file beside the take during which, or soon after which, it was sent."""
        self.source(source).add_c3d(file.path)

    async def recorded_messages(self, source: str, key: str, wanted: WantedMessages) -> FoundMessages | None:
        """Return messages from the rolling segments."""
        return await self._sources[source].find(key, wanted) if source in self._sources else None

    def oldest_recorded(self, source: str, key: str) -> tuple[int, int] | None:
        """Return number and time of the oldest message in the rolling segments."""
        return self._sources[source].oldest(key) if source in self._sources else None

    def serve_queries(self, service: QueryService) -> None:
        """Use ``service`` to describe the sources in the files."""
        self.storage.server = service.server

    @property
    def commands(self) -> Mapping[str, Command]:
        """The command take, by which peers use the takes."""
        return {"take": self._command}

    async def stop_queries(self) -> None:
        """Prepare for ``close``: forget when takes that are being saved would end."""
        for source in self._sources.values():
            for timer in source.saves.values():
                timer.cancel()

    def close(self) -> None:
        """End all takes; wait for the disk, but not for long."""
        if self.storage.is_closed:
            return
        self.storage.is_closed = True
        writer = self.storage.writer
        if writer is not None:
            for source in self._sources.values():
                source.end()
            if not writer.close(_CLOSE_S):
                logger.warning(
                    "takes: the disk of %s does not respond; %d bytes are not written",
                    *(self.storage.folder.directory, writer.queued_bytes),
                )
                return
        self.storage.watch.close()
