"""The way of C3D files from streams to the disk, with real threads and a real folder."""

import asyncio
import os
import threading
from pathlib import Path

import pytest

from gateway.errors import FileLoss, SpoolError
from gateway.rtc3d.packets import FilePiece
from gateway.session.c3d_files import receiving
from gateway.session.c3d_files.receiving import FileReceiver, SourceFiles
from gateway.session.c3d_files.spool import QueueMemory, Spool, StoredFile
from tests.support.errors import names
from tests.support.servers import c3d_file
from tests.support.waiting import wait_until_async

FILE = c3d_file(b"the end", 2000)


class Lab:
    """The files of a source. ``stored`` and ``lost`` are what was reported."""

    def __init__(self, folder: Path, *, max_bytes: int = 10_000, max_queued_bytes: int = 1_000_000) -> None:
        self.spool = Spool(folder, 100, max_bytes, max_queued_bytes)
        self.stored: list[StoredFile] = []
        self.lost: list[SpoolError] = []
        self.files = SourceFiles("lab", lambda: self.spool, self.stored.append)
        self.receiver = self.new_receiver()

    def new_receiver(self) -> FileReceiver:
        return FileReceiver(self.files, self.lost.append)

    def send(self, content: bytes, receiver: FileReceiver | None = None, piece_bytes: int = 300) -> None:
        """Send a whole file in pieces."""
        for start in range(0, len(content) or 1, piece_bytes):
            piece = FilePiece(content[start : start + piece_bytes], start, len(content))
            (receiver or self.receiver).receive(piece)

    def begin(self, content: bytes, num_bytes: int) -> None:
        """Send the first bytes of a file."""
        self.receiver.receive(FilePiece(content[:num_bytes], 0, len(content)))

    async def store(self) -> None:
        """Send a file, and wait until it is stored."""
        count = len(self.stored)
        self.send(FILE)
        await wait_until_async(lambda: len(self.stored) > count)

    async def ended(self, count: int) -> None:
        await wait_until_async(lambda: len(self.stored) + len(self.lost) == count)
        await self.files._thread.run(lambda: None)  # lost files are deleted

    @property
    def causes(self) -> list[FileLoss]:
        return [error.cause for error in self.lost]

    @property
    def contents(self) -> list[bytes]:
        return [path.read_bytes() for path in sorted(self.spool.directory.iterdir())]


class Disk:
    """Stops every write after ``hang`` until ``respond``, as a hung disk does."""

    def __init__(self) -> None:
        self._responds = threading.Event()
        self._responds.set()
        self._write = os.write
        self.hang, self.respond = self._responds.clear, self._responds.set

    def write(self, descriptor: int, data: memoryview) -> int:
        self._responds.wait()
        return self._write(descriptor, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    disk = Disk()
    monkeypatch.setattr(os, "write", disk.write)
    return disk


@pytest.mark.parametrize("piece_bytes", [1, 2, 3, 511, 5000])
async def test_a_file_is_stored_whatever_its_pieces(tmp_path: Path, piece_bytes: int) -> None:
    lab = Lab(tmp_path)
    lab.send(FILE, piece_bytes=piece_bytes)
    await lab.ended(1)
    assert lab.contents == [FILE]
    assert [stored.num_bytes for stored in lab.stored] == [len(FILE)]
    assert lab.spool.memory.held_bytes == 0


async def test_files_of_two_streams_may_arrive_at_the_same_time(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    other, content = lab.new_receiver(), c3d_file(b"another", 3000)
    lab.begin(FILE, 1000)
    lab.send(content, other)
    lab.receiver.receive(FilePiece(FILE[1000:], 1000, len(FILE)))
    await lab.ended(2)
    assert sorted(lab.contents) == sorted([FILE, content])


@pytest.mark.parametrize(
    ("content", "cause", "values"),
    [
        (b"", FileLoss.NO_C3D_FILE, [0]),
        (b"P", FileLoss.NO_C3D_FILE, [1, 512]),
        (bytes(5000), FileLoss.NO_C3D_FILE, [5000]),
        (c3d_file(b"", 10_001), FileLoss.TOO_LARGE, ["lab", 10_001, "spool.max_bytes", 10_000]),
    ],
)
async def test_other_files_are_refused_and_skipped(
    tmp_path: Path, content: bytes, cause: FileLoss, values: list[object]
) -> None:
    lab = Lab(tmp_path)
    for piece_bytes in (1, 5000):
        lab.send(content, piece_bytes=piece_bytes)
    assert lab.causes == [cause, cause]
    assert names(str(lab.lost[0]), *values)
    await lab.store()
    assert lab.contents == [FILE]


async def test_a_file_that_breaks_off_is_deleted_and_its_rest_is_no_other_file(tmp_path: Path) -> None:
    """The end of a connection between files loses nothing; pieces without a beginning are skipped."""
    lab = Lab(tmp_path)
    await lab.store()
    lab.receiver.interrupt("closed")
    lab.begin(FILE, 1000)
    lab.receiver.interrupt("the connection broke")
    lab.receiver.interrupt("again")
    lab.receiver.receive(FilePiece(FILE[1000:], 1000, len(FILE)))
    await lab.ended(2)
    assert lab.contents == [FILE]
    await lab.store()  # of the next connection
    assert lab.causes == [FileLoss.BROKEN_OFF]
    assert names(str(lab.lost[0]), "lab", 2000, 1000, "the connection broke")
    assert lab.contents == [FILE, FILE]


async def test_a_file_on_a_full_disk_is_lost_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(tmp_path)

    def fail(_descriptor: int, _data: memoryview) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(os, "write", fail)
        lab.send(FILE)
        await lab.ended(1)
    assert lab.causes == [FileLoss.NOT_WRITTEN]
    assert names(str(lab.lost[0]), "lab", 2000, tmp_path, os.strerror(28), "spool.directory")
    assert lab.spool.memory.held_bytes == 0
    await lab.store()
    assert lab.contents == [FILE]


async def test_a_disk_that_hangs_takes_no_more_memory_than_its_share(tmp_path: Path, disk: Disk) -> None:
    lab = Lab(tmp_path, max_queued_bytes=10_000)
    disk.hang()
    lab.send(c3d_file(b"", 9000), piece_bytes=500)
    assert lab.causes == [FileLoss.NO_MEMORY]
    assert names(str(lab.lost[0]), "lab", 9000, "0 MiB")
    assert lab.spool.memory.held_bytes <= 700  # the piece that is being written
    disk.respond()
    await lab.ended(1)
    assert lab.contents == []
    await lab.store()
    assert lab.contents == [FILE]


async def test_at_most_four_files_wait_for_the_disk(tmp_path: Path, disk: Disk) -> None:
    lab = Lab(tmp_path)
    disk.hang()
    for _ in range(6):
        lab.send(FILE)
    assert lab.causes == 2 * [FileLoss.DISK_BUSY]
    assert names(str(lab.lost[0]), 2000, 4)
    disk.respond()
    await lab.ended(6)
    assert lab.contents == 4 * [FILE]


async def test_the_files_that_wait_for_a_disk_that_does_not_respond_are_given_up(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receiving, "_MAX_DISK_S", 0.0)
    lab = Lab(tmp_path)
    lab.files.check()
    disk.hang()
    lab.send(FILE)
    lab.begin(FILE, 1000)
    await wait_until_async(lambda: lab.files._thread.call_age_s > 0)
    lab.files.check()
    assert lab.causes == 2 * [FileLoss.DISK_SILENT]
    assert names(str(lab.lost[0]), "lab", 2000, tmp_path)
    lab.receiver.receive(FilePiece(FILE[1000:], 1000, len(FILE)))
    lab.send(FILE)
    assert lab.causes == 3 * [FileLoss.DISK_SILENT]
    assert names(str(lab.lost[2]), 2000, tmp_path)
    assert lab.spool.memory.held_bytes <= 500
    disk.respond()
    await lab.ended(3)
    assert lab.contents == []
    await wait_until_async(lambda: lab.files._thread.call_age_s == 0)
    lab.files.check()
    await lab.store()
    assert lab.contents == [FILE]


async def test_a_flood_of_files_is_limited(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    for number in range(receiving._MAX_FILES_AT_ONCE + 2):
        lab.send(FILE)
        await lab.ended(number + 1)
    assert len(lab.stored) == receiving._MAX_FILES_AT_ONCE
    assert lab.causes == 2 * [FileLoss.TOO_OFTEN]
    assert names(str(lab.lost[0]), "lab", 2000, "3 s")
    lab.files._allowed._updated_s -= 3.0
    for _ in range(2):
        lab.send(FILE)
    await lab.ended(receiving._MAX_FILES_AT_ONCE + 4)
    assert len(lab.stored) == receiving._MAX_FILES_AT_ONCE + 1


async def test_the_end_of_a_source_waits_for_the_disk_but_not_long(tmp_path: Path, disk: Disk) -> None:
    lab = Lab(tmp_path)
    lab.send(FILE)
    await lab.files.finish()
    assert lab.contents == [FILE]
    assert len(lab.stored) == 1
    disk.hang()
    lab.send(FILE)
    async with asyncio.timeout(20):
        await lab.files.finish()
    disk.respond()
    await lab.ended(2)


# The memory of all sources -------------------------------------------------------------------

PIECE = bytes(800)  # and 200 bytes of overhead


def reserved(memory: QueueMemory, source: str, piece: bytes = PIECE) -> int:
    """Reserve as many pieces as a source can have; return their number."""
    count = 0
    while memory.reserve(source, piece):
        count += 1
    return count


def test_a_source_gets_half_of_the_memory_and_leaves_the_others_their_share() -> None:
    memory = QueueMemory(120_000)
    assert [reserved(memory, source) for source in "abca"] == [60, 30, 15, 0]
    assert memory.held_bytes == 105_000
    for _ in range(60):
        memory.release("a", PIECE)
    assert memory.held_bytes == 45_000
    assert reserved(memory, "a") == 38
    assert reserved(QueueMemory(2000), "a", b"") == 5  # pieces without content take memory too
