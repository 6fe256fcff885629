"""Takes on a disk that is full, slow, gone, or not what it should be."""

import asyncio
import contextlib
import errno
import logging
import os
import resource
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

from gateway.errors import OutputError, QueryError
from gateway.messages.decode import decode
from gateway.messages.history import WantedMessages
from gateway.outputs.contract import ServerParameters, encode_parameters
from gateway.outputs.takes import disk as disk_calls
from gateway.outputs.takes import segments
from gateway.outputs.takes.disk import Disk
from gateway.outputs.takes.folder import ROLLING, TakesFolder
from gateway.outputs.takes.segment_index import read_planned
from gateway.outputs.takes.segments import RollingSegments, Save
from gateway.outputs.takes.take_file import SourceFacts, SourceWriter
from gateway.runtime.losses import Losses
from gateway.takes.files.description import SourceDescription
from gateway.takes.files.take_writer import RETRY_S
from gateway.takes.files.writer_thread import LogFile
from tests.support.errors import names, raises
from tests.support.recording_output import RecordingLab, frames, recording_lab
from tests.support.records import levels, logged
from tests.support.statuses import amounts
from tests.support.waiting import wait_until_async

MIB = 1024 * 1024


@contextlib.contextmanager
def files_of_at_most(num_bytes: int) -> Iterator[None]:
    """Let the kernel refuse longer files, as on a full disk."""
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@contextlib.contextmanager
def short_limit() -> Iterator[None]:
    """Let nobody wait for the disk for long: only around what the test keeps waiting for ever."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(disk_calls, "_TIMEOUT_S", 0.05)
        yield


async def test_a_full_disk_costs_nothing_if_it_has_room_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A full disk costs nothing if somebody makes room, and is logged once."""
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        with files_of_at_most(300_000):
            published = [lab.publish(size=1000) for _ in range(100)]
            await wait_until_async(lambda: not lab.output.health().connected)
            values = ("walk.lcmlog", os.strerror(errno.EFBIG))
            assert names(lab.output.health().problem, *values)
            with raises(QueryError, *values, code="disk"):
                await lab.takes.save(1)
        await wait_until_async(lambda: lab.output.health().connected)
        stopped = await lab.takes.stop()
    assert frames(lab.path("walk.lcmlog")) == published
    assert stopped.num_lost == 0
    assert levels(caplog).count("WARNING") == 1


@pytest.mark.parametrize("has_begun", [False, True])
async def test_a_save_that_nobody_waits_for_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_begun: bool
) -> None:
    """Nobody would ever end such a take: it would grow until the disk is full."""
    begun, free = threading.Event(), threading.Event()

    def save(*arguments: Any, **options: Any) -> Save:
        begun.set()
        free.wait()
        return saving(*arguments, **options)

    saving = RollingSegments.save
    monkeypatch.setattr(RollingSegments, "save", save)
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        lab.publish()
        await lab.output.storage.written()
        if has_begun:
            task = asyncio.create_task(lab.takes.save(60, 600, "fall"))
            await wait_until_async(begun.is_set)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        else:
            lab.output.storage.started_writer().call(free.wait)
            with short_limit(), raises(QueryError, "respond", code="disk"):
                await lab.takes.save(60, 600, "fall")
        free.set()
        await lab.output.storage.written()
        assert begun.is_set() is has_begun
        assert [*lab.directory.glob("lab/*")] == []
        segments = lab.takes.segments
        assert segments is not None
        assert segments._saves == []


async def test_what_does_not_fit_into_the_queue_is_refused_and_a_gap_in_the_take(tmp_path: Path) -> None:
    """Memory is bounded; what was accepted is in the take, and the caller counts the rest."""
    async with recording_lab(tmp_path, max_queued_bytes=MIB) as lab:
        await lab.takes.start("walk")
        accepted = []
        with files_of_at_most(300_000):
            accepted.append(lab.publish(size=20_000))
            await wait_until_async(lambda: not lab.output.health().connected)
            causes = set()
            for _ in range(10):
                try:
                    accepted.append(lab.publish(size=20_000))
                except OutputError as error:
                    causes.add(error.cause)
            assert causes == {"disk too slow"}
        await wait_until_async(lambda: lab.output.health().connected)
        accepted.append(lab.publish())
        stopped = await lab.takes.stop()
        [listed] = (await lab.takes.list()).takes
    assert frames(lab.path("walk.lcmlog")) == accepted
    assert stopped.num_lost == listed.num_lost == 12 - len(accepted) > 0


async def test_a_take_that_ends_on_a_full_disk_counts_what_is_missing(tmp_path: Path) -> None:
    """The end does not wait for room; the loss is counted, and belongs to that take only."""
    async with recording_lab(tmp_path) as lab:
        losses = Losses(logging.getLogger("gateway"), "lab to takes")
        lab.output.count_losses("lab", losses)
        await lab.takes.start("walk")
        published = [lab.publish()]
        with files_of_at_most(100_000):
            published += [lab.publish(size=1000) for _ in range(100)]
            await wait_until_async(lambda: not lab.output.health().connected)
            assert len(frames(lab.path("walk.lcmlog"))) == 7  # of 16 kB; the eighth does not fit
            stopped = await lab.takes.stop()
        assert lab.output.health().connected  # whether the problem persists is not known
        await lab.takes.start("next")
        next_one = lab.publish()
        await lab.takes.stop()
        assert lab.output.health().connected
    assert frames(lab.path("next.lcmlog")) == [next_one]
    found = frames(lab.path("walk.lcmlog"))
    assert found == published[: len(found)]
    assert stopped.num_lost == len(published) - len(found) > 0
    # The end of the file has taken the place of the newest message that had found room.
    [listed] = (take for take in TakesFolder(tmp_path).takes("lab", ()) if take.name == "walk")
    assert (listed.num_lost, listed.is_cut_off) == (stopped.num_lost, False)
    assert amounts(losses.report()) == {"not written": (stopped.num_lost, stopped.num_lost)}


async def test_a_folder_that_does_not_exist_is_created_at_the_start_only(tmp_path: Path) -> None:
    """A folder that is missing later is a disk that is not mounted: its mount point must stay empty."""
    async with recording_lab(tmp_path / "disk" / "takes") as lab:
        (tmp_path / "disk").rename(tmp_path / "unmounted")
        await until_problem(lab, "No such file or directory; is the disk mounted?")
        with raises(QueryError, "mounted", code="disk"):
            await lab.takes.start("walk")
        (tmp_path / "disk").mkdir()
        (tmp_path / "disk/takes").write_text("no folder")
        await until_problem(lab, "it is not a folder; choose a folder as takes.directory")
        (tmp_path / "disk/takes").unlink()
        (tmp_path / "disk").rmdir()
        (tmp_path / "unmounted").rename(tmp_path / "disk")
        await wait_until_async(lambda: not lab.output.health().problem)
        await lab.takes.start("walk")
    assert lab.path("walk.lcmlog").is_file()


async def test_the_folder_of_the_user_is_created(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a setting, takes are where systemd lets the service write."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    async with recording_lab(None) as lab:
        await lab.takes.start("walk")
    assert (tmp_path / "state" / "takes" / "lab" / "walk.lcmlog").is_file()


async def test_a_take_without_its_file_gets_a_new_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Messages must not go on into a file that has no name any more."""
    async with recording_lab(tmp_path) as lab:
        await lab.takes.start("walk")
        lab.publish()
        await wait_until_async(lambda: len(frames(lab.path("walk.lcmlog"))) == 1)
        lab.path("walk.lcmlog").unlink()

        def is_back() -> bool:
            lab.publish()
            return lab.path("walk.lcmlog").exists()

        await wait_until_async(is_back)
        newest = lab.publish()
        await lab.takes.stop()
    assert frames(lab.path("walk.lcmlog"))[-1] == newest
    assert [(each.level, each.args[0]) for each in logged(caplog)] == [("WARNING", lab.path("walk.lcmlog"))]


async def test_stopping_on_a_full_disk_says_so(tmp_path: Path) -> None:
    """The segments wait before the take does; the peer learns the reason instead of "no answer"."""
    async with recording_lab(tmp_path, keep_last_s=60) as lab:
        await lab.takes.start("walk")
        with files_of_at_most(100_000):
            for _ in range(100):
                lab.publish(size=1000)
            await wait_until_async(lambda: not lab.output.health().connected)
            with short_limit(), raises(QueryError, os.strerror(errno.EFBIG), code="disk"):
                await lab.takes.stop()
        await wait_until_async(lambda: lab.output.health().connected)


async def test_a_disk_that_hangs_is_reported(tmp_path: Path) -> None:
    """The event loop goes on, and the take that was not started does not appear later."""
    async with recording_lab(tmp_path) as lab:
        lab.path("").mkdir()
        responds = threading.Event()
        lab.output.storage.started_writer().call(responds.wait)
        with short_limit(), raises(QueryError, "respond", code="disk"):
            await lab.takes.start("walk")
        assert not lab.publishers["3d"].wanted
        responds.set()
        await lab.output.storage.written()
        await lab.takes.start("run")
    assert [path.name for path in lab.path("").glob("*.lcmlog")] == ["run.lcmlog"]


async def test_messages_on_a_disk_that_hangs_are_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who asks for them may ask again; nobody waits for long, and nothing is read for those who gave up."""
    responds = threading.Event()
    num_reads = 0

    def read(*arguments: Any) -> Any:
        nonlocal num_reads
        num_reads += 1
        responds.wait()
        return read_planned(*arguments)

    monkeypatch.setattr(segments, "read_planned", read)
    async with recording_lab(tmp_path, keep_last_s=60.0) as lab:
        message = lab.publish()
        await lab.output.storage.written()
        ask = partial(lab.output.recorded_messages, "lab", "3d", WantedMessages(0, None, 0))
        with short_limit():
            refused = await asyncio.gather(*(ask() for _ in range(20)), return_exceptions=True)
        assert [getattr(each, "code", None) for each in refused] == ["busy"] * 20
        late = [each for each in refused if "did not respond" in str(each)]
        assert len(late) == disk_calls.MAX_HISTORY_READS
        with raises(QueryError, "too many", code="busy"):
            await ask()
        responds.set()
        await wait_until_async(lambda: lab.output.storage._num_history_reads == 0)
        found = await ask()
        assert found is not None
        assert found.messages == [message]
        assert num_reads <= 2  # of those who gave up, one has begun, or none
        lab.output.storage.started_writer().call(responds.clear)
        lab.output.storage.started_writer().call(responds.wait)
        with short_limit(), raises(QueryError, "respond") as refusal:
            await lab.output.recorded_messages("lab", "3d", WantedMessages(0))
        assert refusal.value.code == "busy"
        responds.set()


async def until_problem(lab: RecordingLab, text: str) -> None:
    await wait_until_async(lambda: text in lab.output.health().problem)


async def test_the_end_of_the_output_ends_the_take(tmp_path: Path) -> None:
    """What was published before the end is in the file, written by the thread that ends, too."""
    async with recording_lab(tmp_path, keep_last_s=10) as lab:
        await lab.takes.start("walk")
        published = [lab.publish(size=1000) for _ in range(200)]
    assert frames(lab.path("walk.lcmlog")) == published
    assert not (tmp_path / ROLLING / "lab").exists()


# A disk that accepts everything, a part, or nothing, as the test says ---------------------------

FULL = OSError(errno.ENOSPC, "No space left on device")

Messages = Sequence[tuple[bytes, bytes]]


def message(number: int, channel: str = "3D") -> tuple[bytes, bytes]:
    """Return a message with this ``utime``, and its channel."""
    return f"MOCAP_LAB_{channel}".encode(), bytes(8) + number.to_bytes(8, "big")


def parameters(version: int) -> tuple[bytes, bytes]:
    """Return a ``parameters_t`` and its channel."""
    content = ServerParameters(b"<a/>", 1, version)
    return b"MOCAP_LAB_PARAMETERS", encode_parameters(content, utime=1, arrived_utime=1, sequence=0)


class ScriptedLog:
    """A log that does what ``steps`` say, one per call: take so many messages, or fail; then take all."""

    def __init__(self, *steps: int | OSError) -> None:
        self.steps = [*steps]
        self.num_bytes = 0
        self.content: list[tuple[bytes, bytes]] = []
        self.sizes: list[int] = []
        self.on_failure: Callable[[], None] = lambda: None

    def append(self, messages: Messages) -> int:
        step = self.steps.pop(0) if self.steps else len(messages)
        if isinstance(step, OSError):
            self.on_failure()
            raise step
        self.sizes.append(step)
        self.content += messages[:step]
        return step


class Waits(threading.Event):
    """The event by which a sink gives up; it notes how long the sink waits for it, and does not wait."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.seconds.append(timeout)
        return self.is_set()


class Sink(SourceWriter):
    """A sink whose log is scripted."""

    def __init__(self, log: ScriptedLog) -> None:
        self.losses = Losses(logging.getLogger("gateway"), "lab to takes")
        facts = SourceFacts(SourceDescription("lab", "MOCAP_LAB"), None, Disk(), self.losses)
        super().__init__(Path("/takes/lab/walk.lcmlog"), facts)
        self.log = log
        self.utimes: list[int] = []
        self.waits = Waits()
        self._gives_up = self.waits
        self.newest_version: list[int | None] = []

    def log_for(self, utime: int) -> LogFile:
        self.utimes.append(utime)
        newest = self._parameters
        self.newest_version.append(None if newest is None else decode(newest).parameters_version)
        return cast(LogFile, self.log)


def test_what_the_disk_does_not_take_at_once_is_written_again_after_a_wait() -> None:
    """Nothing is lost, doubled or reordered; without the wait, a full disk would keep a processor busy."""
    sink = Sink(ScriptedLog(3, FULL, FULL, 1))
    problems: list[str] = []
    sink.log.on_failure = lambda: problems.append(sink.disk.problem)
    sent = [message(number) for number in range(10)]
    sink.write(sent)
    assert sink.log.content == sent
    assert sink.utimes == [0, 3, 3, 3, 4]  # of the first message that is left
    assert sink.waits.seconds == [RETRY_S, RETRY_S]
    assert names(problems[1], os.strerror(errno.ENOSPC), "room")
    assert (sink.disk.problem, sink.num_lost, sink.losses.report()) == ("", 0, [])


def test_what_is_given_up_is_counted_in_messages_and_in_frames() -> None:
    """A frame has a message on each channel: six messages of three frames are three frames lost."""
    sink = Sink(ScriptedLog(2, FULL, FULL, FULL))  # the second time is the last try
    sink.log.on_failure = sink.give_up
    frames = [message(number, channel) for number in range(3) for channel in ("3D", "6D", "ANALOG")]
    sink.write(frames[:-1])
    assert sink.log.content == frames[:2]
    assert sink.num_lost == 6
    assert amounts(sink.losses.report()) == {"not written": (6, 2)}
    assert "No space left" in sink.losses.report()[0].text
    sink.write([message(9)])  # a loss is added to those before
    assert sink.num_lost == 7
    assert amounts(sink.losses.report()) == {"not written": (7, 3)}
    sink.write([message(10)])  # the disk has room again
    assert sink.log.content[-1] == message(10)


@pytest.mark.parametrize(
    ("number", "sizes"), [(1, [1]), (512, [512]), (513, [512, 1]), (1300, [512, 512, 276])]
)
def test_many_messages_are_written_in_pieces(number: int, sizes: list[int]) -> None:
    """Between pieces, a segment may end; one piece of a stall of minutes would make it much too long."""
    sink = Sink(ScriptedLog())
    sent = [message(each) for each in range(number)]
    sink.write(sent)
    assert sink.log.sizes == sizes
    assert sink.log.content == sent


def test_a_problem_of_the_disk_and_its_end_are_logged_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Without the second line, a reader of the log takes the problem for a present one."""
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(disk_calls, "HOLD_S", 0.0)
    disk = Disk()
    for call in (disk.succeeded, *[lambda: disk.failed(Path("/takes"), FULL)] * 3, *[disk.succeeded] * 2):
        call()
    assert levels(caplog, logging.INFO) == ["WARNING", "INFO"]
    assert names(caplog.messages[0], "/takes", os.strerror(errno.ENOSPC))


def test_a_new_file_begins_with_the_parameters_that_were_written_last() -> None:
    """Otherwise, the labels of the next segment would be those of an earlier configuration."""
    sink = Sink(ScriptedLog())
    some = [message(each) for each in range(510)]
    sink.write([parameters(1), *some, parameters(2), *some])
    sink.write([message(1)])
    assert sink.newest_version == [None, 2, 2]
