"""Writing to a disk that accepts everything, a part, or nothing: the disk is a script of the test."""

import errno
import logging
import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import pytest

from gateway.losses import Losses
from gateway.messages.decode import decode
from gateway.outputs.contract import ServerParameters
from gateway.outputs.parameters_message import encode_parameters
from gateway.outputs.takes.disk import RETRY_S, Disk
from gateway.outputs.takes.header import FileHeader, SourceDescription
from gateway.outputs.takes.log_sink import LogSink
from gateway.takes.recording import LogFile
from tests.losses import amounts

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


class Sink(LogSink):
    """A sink whose log is scripted."""

    def __init__(self, log: ScriptedLog) -> None:
        self.losses = Losses(logging.getLogger("gateway"), "lab to takes")
        super().__init__(FileHeader(SourceDescription("lab", "MOCAP", ""), None), Disk(), self.losses)
        self.log = log
        self.utimes: list[int] = []
        self.waits = Waits()
        self._gives_up = self.waits
        self.newest_version: list[int | None] = []

    @property
    def path(self) -> Path:
        return Path("/takes/lab/walk.lcmlog")

    def log_for(self, utime: int) -> LogFile:
        self.utimes.append(utime)
        newest = self.header.parameters
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
    assert "No space left on device; make room on it" in problems[1]
    assert (sink.disk.problem, sink.num_lost, sink.losses.report()) == ("", 0, [])


def test_what_is_given_up_is_counted_in_messages_and_in_frames() -> None:
    """A frame has a message on each channel: six messages of three frames are three frames lost."""
    sink = Sink(ScriptedLog(2, FULL, FULL))
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


def test_a_file_that_cannot_begin_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty file of that name would refuse the next attempt."""

    def write(_descriptor: int, _content: memoryview) -> int:
        raise FULL

    header = FileHeader(SourceDescription("lab", "MOCAP", ""), None)
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write)
        with pytest.raises(OSError, match="No space left"):
            header.begin_log(tmp_path / "walk.lcmlog", "walk", 1)
    header.begin_log(tmp_path / "walk.lcmlog", "walk", 1).close()


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


def test_a_new_file_begins_with_the_parameters_that_were_written_last() -> None:
    """Otherwise, the labels of the next segment would be those of an earlier configuration."""
    sink = Sink(ScriptedLog())
    some = [message(each) for each in range(510)]
    sink.write([parameters(1), *some, parameters(2), *some])
    sink.write([message(1)])
    assert sink.newest_version == [None, 2, 2]
