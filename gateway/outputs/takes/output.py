"""The output that records takes on this computer, where nothing can be lost on the way."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from gateway.logs.losses import Losses
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
from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.follow import EventPublisher, TakeFollower
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.takes import Takes
from gateway.rtc3d.components import ComponentType
from gateway.takes.files.writer_thread import MAX_QUEUED_BYTES


class TakesOutput(Output):
    """Records messages in files, while a take is running and for the rolling segments."""

    name = "takes"
    drop_causes = ("disk too slow", "not written", "folder full")

    def __init__(
        self, settings: TakesSettings, max_queued_bytes: int = MAX_QUEUED_BYTES, host: Host | None = None
    ) -> None:
        self.has_tool_poses = settings.tool_poses
        self._host = host or Host()
        self.takes = Takes(settings, max_queued_bytes, self._host)
        """What is recorded, and what peers can do with it."""
        self._command = TakeCommand(self.takes, self._host.monotonic)
        self._followers: dict[str, TakeFollower] = {}  # by source

    def start(self) -> None:
        """Start to check the folder and to write."""
        self.takes.open()

    def publisher(self, topic: Topic) -> Publisher:
        """Return a new publisher of ``topic``, under a channel as on LCM."""
        recording = self.takes.recording(topic.source)
        publisher = recording.publisher(topic, self.takes.refusal, self.takes.queue_full)
        if topic.path == (ComponentType.EVENT.key,):
            return EventPublisher(publisher, self._follower(topic.source))
        return publisher

    def _follower(self, source: str) -> TakeFollower:
        if source not in self._followers:
            self._followers[source] = TakeFollower(source, self.takes, self._host.monotonic)
        return self._followers[source]

    def watch_wanted(self, source: str, on_change: Callable[[], None]) -> bool:
        """Messages are wanted while a take is running or the last seconds are kept."""
        self.takes.recording(source).on_wanted_changed = on_change
        return True

    def health(self) -> OutputHealth:
        """Return whether takes can be recorded."""
        problem = self.takes.problem
        return OutputHealth(not problem, problem)

    def maintain(self) -> None:
        """Check the folder and its limits, and whether measurements have ended."""
        self.takes.maintain()
        for follower in self._followers.values():
            follower.maintain()

    def is_configured_like(self, other: Output) -> bool:
        """Any settings can be taken over."""
        return isinstance(other, TakesOutput)

    def take_over(self, other: Output) -> bool:
        """Apply other settings; running takes go on."""
        assert isinstance(other, TakesOutput)  # noqa: S101 - is_configured_like says so
        if self.takes.settings == other.takes.settings:
            return False
        self.has_tool_poses = other.has_tool_poses
        self.takes.change(other.takes.settings)
        return True

    def count_losses(self, source: str, losses: Losses) -> None:
        """Count in ``losses`` what the disk does not accept."""
        self.takes.recording(source).losses = losses

    def announce(self, source: str) -> None:
        """Accept takes of ``source``."""
        self.takes.announce(source)

    def withdraw(self, source: str) -> None:
        """End what is recorded of ``source``."""
        self.takes.withdraw(source)
        self._followers.pop(source, None)

    def show_measurement(self, source: str, is_running: bool | None) -> None:
        """Start a take with a measurement, if the settings say so."""
        self._follower(source).show_measurement(is_running)

    async def follow_recording(self, source: str, *, start: bool, name: str) -> Mapping[str, Any]:
        """Start and stop a take with a recording, if the settings say so."""
        return await self._follower(source).follow_recording(start=start, name=name)

    def publish_parameters(self, source: str, parameters: ServerParameters) -> asyncio.Future[None] | None:
        """Record the parameters now and at the beginning of each file."""
        return self.takes.recording(source).publish_parameters(parameters)

    def announce_file(self, source: str, file: ServerFile) -> None:
        """Link or copy the C3D file beside the take during which, or soon after which, it was sent."""
        self.takes.add_c3d(source, file.path)

    def serve_queries(self, service: QueryService) -> None:
        """Use ``service`` to describe the sources in the files."""
        self.takes.server = service.server

    @property
    def commands(self) -> Mapping[str, Command]:
        """The command take, by which peers use the takes."""
        return {"take": self._command}

    async def stop_queries(self) -> None:
        """Prepare for ``close``."""
        self.takes.cancel_timers()

    def close(self) -> None:
        """End all takes; wait for the disk, but not for long."""
        self.takes.close()
