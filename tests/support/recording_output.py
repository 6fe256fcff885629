"""An output that records takes, with a source whose messages the test publishes."""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import rtc3d

from gateway.messages.encode import MESSAGE_TYPES, lcm_type_name
from gateway.messages.host_time import now_utime
from gateway.messages.topics import Topic
from gateway.outputs.takes.disk import Host
from gateway.outputs.takes.output import TakesOutput
from gateway.outputs.takes.settings import TakesSettings
from gateway.outputs.takes.source_takes import SourceTakes
from gateway.rtc3d.components import COMPONENTS_BY_KEY
from gateway.runtime.workers import WorkerThread, make_call
from gateway.takes.files.event_log import Event
from gateway.takes.files.reader import TakeReader
from gateway.takes.files.writer_thread import MAX_QUEUED_BYTES, WriterThread
from tests.support.clocks import Clock
from tests.support.waiting import wait_until_async

_Result = TypeVar("_Result")


class NoThread(WorkerThread):
    """Makes each call at once, where it is submitted."""

    def submit(self, call: Callable[[], _Result]) -> Future[_Result]:
        done: Future[_Result] = Future()
        make_call(done, call)
        return done


def still_host(monotonic: Callable[[], float]) -> Host:
    """Return a host without threads, on this clock: whoever waits for the disk has its answer at once."""
    return Host(monotonic, thread=NoThread, writer=partial(WriterThread, has_thread=False))


class RecordingLab:
    """The source "lab" on an output whose folder is ``directory``."""

    def __init__(
        self,
        directory: Path | None,
        max_queued_bytes: int = MAX_QUEUED_BYTES,
        host: Host | None = None,
        **settings: Any,
    ) -> None:
        self.directory = Path() if directory is None else directory
        self.output = TakesOutput(settings_in(directory, **settings), max_queued_bytes, host)
        self.publishers = {
            component.key: self.output.publisher(Topic("lab", (component.key,), lcm_type_name(kind)))
            for component, kind in MESSAGE_TYPES.items()
        }
        self.output.announce("lab")
        self._sequence = 0

    @property
    def takes(self) -> SourceTakes:
        """The takes of the source."""
        return self.output.takes("lab")

    def is_recording(self) -> bool:
        """Return whether a take is running."""
        return self.takes.take is not None

    def publish(self, key: str = "3d", size: int = 0) -> bytes:
        """Publish the next message of a component, with ``size`` markers or events; return it."""
        message: Any = MESSAGE_TYPES[COMPONENTS_BY_KEY[key]]()
        message.utime = message.capture_utime = now_utime()
        message.sequence = self._sequence
        self._sequence += 1
        if key == "3d":
            message.num_markers = size
            message.markers = [rtc3d.marker_t() for _ in range(size)]
        encoded: bytes = message.encode()
        self.publishers[key].publish(encoded)
        return encoded

    def path(self, name: str) -> Path:
        return self.directory / "lab" / name


def settings_in(directory: Path | None, **settings: Any) -> TakesSettings:
    """Return settings with this folder; None means the default one."""
    return TakesSettings(enabled=True, directory=None if directory is None else str(directory), **settings)


def events(path: Path) -> list[Event]:
    """Return the events of a take without its end; there must be no damage."""
    reader = TakeReader(path)
    found = [*reader.events()]
    assert not any(log.num_damaged for log in reader.logs)
    return [event for event in found if not event.channel.endswith("_END")]


def frames(path: Path) -> list[bytes]:
    """Return the messages of frames in a take, in order."""
    return [event.message for event in events(path) if not event.channel.endswith(("_TAKE", "_PARAMETERS"))]


@asynccontextmanager
async def recording_lab(directory: Path | None, **settings: Any) -> AsyncIterator[RecordingLab]:
    """Run an output whose folder is ``directory``, and call ``maintain`` as the gateway does."""
    lab = RecordingLab(directory, **settings)
    lab.output.start()

    async def maintain() -> None:
        while True:
            lab.output.maintain()
            await asyncio.sleep(0.02)

    task = asyncio.create_task(maintain())
    try:
        await wait_until_async(lambda: lab.output.health().connected)
        yield lab
    finally:
        task.cancel()
        await asyncio.to_thread(lab.output.close)


@asynccontextmanager
async def still_lab(
    directory: Path, clock: Callable[[], float] | None = None, **settings: Any
) -> AsyncIterator[RecordingLab]:
    """Run an output without threads; its clock is ``clock``, or else one that stands still.

    With a real clock, the folder is not checked for a while after a check that took long. Messages are
    written when somebody waits for the disk. The test calls ``maintain`` itself.
    """
    lab = RecordingLab(directory, host=still_host(clock or Clock()), **settings)
    lab.output.start()
    try:
        yield lab
    finally:
        lab.output.close()
