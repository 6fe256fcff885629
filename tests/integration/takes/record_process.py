"""``rtc3d-gateway record`` as a program of its own, and a publisher of the test which it records."""

import os
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from gateway.messages.stamp import PREFIX
from gateway.subscriber.series import FINGERPRINTS
from gateway.takes.event_log import EventLogReader
from tests.gateway_process import PROGRAM
from tests.networks import free_endpoint, open_zenoh
from tests.waiting import wait_until


class Ended(NamedTuple):
    status: int
    stdout: str
    stderr: str


class RecordProcess:
    """A running ``record``."""

    def __init__(self, process: subprocess.Popen[str], stderr: Path) -> None:
        self.process = process
        self._stderr = stderr

    @property
    def stderr(self) -> str:
        return self._stderr.read_text()

    def end(self, number: signal.Signals | None = signal.SIGINT) -> Ended:
        """Wait for the end of the program, after a signal if given."""
        if number is not None:
            self.process.send_signal(number)
        stdout, _ = self.process.communicate(timeout=60)
        assert "Traceback" not in self.stderr + stdout
        assert "defect" not in self.stderr
        return Ended(self.process.returncode, stdout, self.stderr)


@contextmanager
def recording(tmp_path: Path, *arguments: str, command: tuple[str, ...] = PROGRAM) -> Iterator[RecordProcess]:
    """Run ``record`` with these arguments until the end of the block."""
    stderr = tmp_path / "stderr"
    with (
        stderr.open("w") as file,
        subprocess.Popen(
            [*command, "record", *arguments],
            stdout=subprocess.PIPE,
            stderr=file,
            text=True,
            env=os.environ | {"COLUMNS": "200"},
        ) as process,
    ):
        try:
            yield RecordProcess(process, stderr)
        finally:
            process.kill()


def size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def num_recorded(path: Path, channel: str) -> int:
    """Return how many messages of a channel a recording has so far."""
    return path.read_bytes().count(channel.encode()) if path.exists() else 0


def events(path: Path) -> list[tuple[str, bytes]]:
    """Return the channels and messages of a file, which must not be damaged."""
    reader = EventLogReader(path)
    found = [(event.channel, event.message) for event in reader.events()]
    assert not reader.damage
    return found


def by_channel(path: Path) -> dict[str, list[bytes]]:
    found: defaultdict[str, list[bytes]] = defaultdict(list)
    for channel, message in events(path):
        found[channel].append(message)
    return found


class Publisher:
    """Publishes markers of sources on Zenoh, as a gateway would; ``record`` connects to it."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session = open_zenoh("peer", listen=self.endpoint)

    def publish(self, source: str, *sequences: int, key: str = "3d", session: int = 1) -> None:
        for sequence in sequences:
            utime = time.time_ns() // 1000
            message = FINGERPRINTS[key] + PREFIX.pack(utime, utime, sequence, session, 1) + bytes(16)
            self.session.put(f"mocap/{source}/{key}", message)

    def wait_for_subscriber(self) -> None:
        publisher: Any = self.session.declare_publisher("mocap/lab/3d")
        wait_until(lambda: publisher.matching_status.matching)
        publisher.undeclare()


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    publisher = Publisher()
    yield publisher
    publisher.session.close()


@contextmanager
def recording_of(publisher: Publisher, tmp_path: Path, *options: str) -> Iterator[RecordProcess]:
    with recording(tmp_path, str(tmp_path / "walk"), "--connect", publisher.endpoint, *options) as record:
        publisher.wait_for_subscriber()
        yield record
