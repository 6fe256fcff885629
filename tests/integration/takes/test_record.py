"""``record`` as a program of its own, beside a gateway or a publisher of the test, on real Zenoh and LCM."""

import errno
import itertools
import os
import pty
import re
import resource
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest
import rtc3d

from gateway.client.sources import FINGERPRINTS
from gateway.messages.decode import decode, prefix_of
from gateway.messages.encode import PREFIX
from gateway.messages.topics import MAX_SOURCES
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.statistics import take_statistics
from tests.support.errors import names
from tests.support.gateway_process import PROGRAM
from tests.support.networks import free_endpoint, lcm_url, open_zenoh
from tests.support.record_process import (
    COMPONENTS,
    RecordProcess,
    assert_same_bytes,
    by_channel,
    events,
    lab,
    num_recorded,
    recording,
    size,
)
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

# A gateway -----------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_a_recording_has_what_was_published_with_parameters_first(tmp_path: Path, side: str) -> None:
    """It begins with its description; the parameters, which LCM repeats every 5 s, are there once each."""
    path = tmp_path / "walk.lcmlog"
    renames = ("--fault", "rename,every_s=3,for_s=1.5")
    with lab(tmp_path, side, *renames, parameters_interval_s=0.3) as gateway:
        with recording(path, *gateway.options) as record:
            wait_until(lambda: num_recorded(path, "MOCAP_LAB_1_PARAMETERS") > 3)
            ended = record.end(signal.SIGTERM)
        assert_same_bytes(path, gateway.published)
    assert ended.status == 0, ended
    assert f"{path}: " in ended.stdout
    assert ended.stdout.endswith("complete: no gaps\n")
    for row in (*COMPONENTS, r"6d/\*", "status", "clock"):
        assert re.search(rf"^Lab-1 +{row} +\d+ .* Hz +- +- +-$", ended.stdout, re.MULTILINE), row
    found = events(path)
    assert [channel for channel, _ in found[:2]] == ["MOCAP_LAB_1_TAKE", "MOCAP_LAB_1_PARAMETERS"]
    take = decode(found[0][1])
    assert (take.name, take.source, take.channels) == ("walk", "Lab-1", "MOCAP_LAB_1")
    assert take.server.startswith("127.0.0.1:")
    assert take.gateway_version
    version, known = 0, {}
    for _, message in found[1:]:
        match decode(message):
            case rtc3d.parameters_t() as parameters:
                assert parameters.parameters_version == version + 1 or not version
                version = parameters.parameters_version
                known[version] = "New" in parameters.xml
            case rtc3d.markers_t() as markers:
                # A frame that was on its way when the parameters at the beginning were fetched may be older.
                assert markers.parameters_version in known or markers.parameters_version < min(known)
    assert {*known.values()} == {True, False}


def test_kill_9_costs_at_most_the_last_second(tmp_path: Path) -> None:
    """What the thread has written is in the file, without any end of the program."""
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path) as gateway, recording(path, *gateway.options) as record:
        wait_until(lambda: size(path) > 600_000)
        killed_utime = prefix_of(gateway.published["MOCAP_LAB_1_3D"][-1]).utime
        record.process.kill()
        record.process.wait()
    reader = EventLogReader(path)
    found = [event for event in reader.events() if event.channel == "MOCAP_LAB_1_3D"]
    # More than the second promised, for a busy computer; less than what a full buffer would take.
    assert found[-1].utime > killed_utime - 15_000_000
    assert reader.num_damaged <= 1
    assert all(damage.offset + damage.num_bytes == size(path) for damage in reader.damage)
    sequences = [prefix_of(event.message).sequence for event in found]
    assert sequences == [*range(sequences[0], sequences[0] + len(sequences))]
    assert take_statistics(path).sources["Lab-1"].is_cut_off


def test_a_full_disk_costs_nothing_if_it_has_room_again_and_is_counted_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path) as gateway, recording(path, *gateway.options) as record:
        record.limit_files(300_000)
        record.wait_for(f"{path} cannot be written: File too large")
        record.limit_files(resource.RLIM_INFINITY)
        record.wait_for("the disk accepts what is written again")
        wait_until(lambda: size(path) > 600_000)
        record.limit_files(300_000)
        wait_until(lambda: (tmp_path / "stderr").read_text().count("File too large") == 2)
        ended = record.end()
        assert_same_bytes(path, gateway.published)
    assert ended.status == 1
    assert take_statistics(path).sources["Lab-1"].is_cut_off
    assert re.search(rf"^[1-9]\d* messages .*: {os.strerror(errno.EFBIG)}$", ended.stdout, re.MULTILINE)
    assert re.search(r"^Lab-1 +3d .* Hz +- +- +[1-9]\d*$", ended.stdout, re.MULTILINE)


def test_the_first_messages_are_recorded_with_the_seconds_given(tmp_path: Path) -> None:
    (folder := tmp_path / "takes").mkdir()
    options = ("--seconds", "2", "--component", "3d")
    with lab(tmp_path) as gateway, recording(folder, *options, *gateway.options) as record:
        assert record.end(None).status == 0
    [path] = folder.iterdir()
    assert re.fullmatch(r"Lab-1-\d{8}-\d{6}\.lcmlog", path.name)
    recorded = by_channel(path)
    assert recorded.keys() == {f"MOCAP_LAB_1_{end}" for end in ("TAKE", "PARAMETERS", "3D", "END")}
    utimes = [prefix_of(message).utime for message in recorded["MOCAP_LAB_1_3D"]]
    assert 0 < utimes[-1] - utimes[0] < 30e6  # on a busy computer, the end comes late


# A publisher of the test, which can do what a gateway does not -------------------------------


class Publisher:
    """Publishes markers of sources on Zenoh, as a gateway would; ``record`` connects to it."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.session = open_zenoh("peer", listen=self.endpoint)

    def publish(self, source: str, *sequences: int, key: str = "3d") -> None:
        for sequence in sequences:
            utime = time.time_ns() // 1000
            message = FINGERPRINTS[key] + PREFIX.pack(utime, utime, sequence, 1, 1) + bytes(16)
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


def publish_until(publisher: Publisher, condition: Callable[[], object]) -> None:
    """Publish something else until ``condition`` holds.

    While anything arrives, a request that nobody answers says that there is no history.
    """
    numbers = itertools.count()

    def holds() -> object:
        publisher.publish("lab", next(numbers), key="force")
        return condition()

    wait_until(holds)


@contextmanager
def recording_of(publisher: Publisher, path: Path, **options: Any) -> Iterator[RecordProcess]:
    with recording(path, "--connect", publisher.endpoint, **options) as record:
        publisher.wait_for_subscriber()
        yield record


def test_gaps_two_gateways_and_hostile_publishers_are_reported(tmp_path: Path, publisher: Publisher) -> None:
    """All messages of known sources are recorded; what is reported is bounded."""
    path = tmp_path / "walk.lcmlog"
    names = ("lab/3d", "lab/status", "lab/parameters", "lab/6d/x", "lab/6d/x/y/z", "l%b/3d", "x" * 200)
    with recording_of(publisher, path) as record:
        publisher.publish("lab", *range(500, 600), *range(605, 700), *range(703, 720))
        publish_until(publisher, lambda: record.has_reported("lost on the way; 8 so far"))
        for number in range(40):
            publisher.publish("twice", 1000 + number, 50 + number)
        record.wait_for("two gateways publish the source twice")
        for number in range(300):
            publisher.publish(f"source-{number}", 0)
        for name in names:
            for payload in (b"", b"\x1b[2J", bytes(1000)):
                publisher.session.put(f"mocap/{name}", payload, attachment=b"[[[")
        publisher.publish("hall", 2**62, -(2**63), 10)
        publisher.publish("lab", 1, key="analog")
        wait_until(lambda: num_recorded(path, "MOCAP_LAB_ANALOG"))
        ended = record.end()
    assert ended.status == 1
    assert re.search(r"^lab +3d +212 .* - +8 +-$", ended.stdout, re.MULTILINE)
    assert "lab 3d: the messages 600 to 604, 700 to 702 are missing\n" in ended.stdout
    recorded = by_channel(path)
    assert (len(recorded["MOCAP_LAB_3D"]), len(recorded["MOCAP_TWICE_3D"])) == (212, 80)
    for text in (
        "two gateways publish the source twice",
        "messages were not recorded: there are more than 256 sources",
        "messages on these keys or channels were not recorded",
    ):
        assert text in ended.stdout
    assert ended.stdout.endswith("INCOMPLETE\n")
    assert "\x1b" not in ended.stdout + ended.stderr
    assert len(ended.stdout.splitlines()) < MAX_SOURCES + 50


def test_a_restart_of_the_gateway_is_told_from_loss(tmp_path: Path, publisher: Publisher) -> None:
    """Nothing is called lost, but nobody knows what the gateway had published before it was started again."""
    with recording_of(publisher, tmp_path / "walk.lcmlog") as record:
        publisher.publish("lab", *range(10))
        record.wait_for("lab: nothing has arrived for 2 s")
        publisher.publish("lab", *range(5))
        wait_until(lambda: num_recorded(tmp_path / "walk.lcmlog", "MOCAP_LAB_3D") == 15)
        ended = record.end()
    assert ended.status == 1, ended
    assert names(ended.stdout, "lab", "again (once)")


def test_a_terminal_shows_the_progress_on_one_line(tmp_path: Path, publisher: Publisher) -> None:
    """A file that is deleted meanwhile is reported at the end."""
    reading, terminal = pty.openpty()
    command = [*PROGRAM, "record", str(tmp_path / "walk"), "--connect", publisher.endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=terminal, text=True) as process:
        publisher.wait_for_subscriber()
        publisher.publish("lab", *range(10), *range(12, 20))
        shown = ""

        def has_shown_the_loss() -> object:
            nonlocal shown
            if select.select([reading], [], [], 0)[0]:
                shown += os.read(reading, 65536).decode()
            line = r"\r.*\d:\d\d  [\d.]+ \w+  .* messages/s  .*/s  2 lost  0 bytes to be written"
            return re.search(line, shown)

        publish_until(publisher, has_shown_the_loss)
        (tmp_path / "walk.lcmlog").unlink()
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=120)
    os.close(terminal)
    os.close(reading)
    assert process.returncode == 1
    assert "2 messages" in shown
    assert names(shown, "2 so far")
    assert names(stdout, "moved or deleted")


@pytest.mark.parametrize(
    ("side", "problem"),
    [
        ("zenoh", "found on Zenoh"),
        ("lcm", "found on LCM"),
        ("", "session to tcp/"),
    ],
)
def test_without_a_gateway_there_is_no_file(
    tmp_path: Path, publisher: Publisher, side: str, problem: str
) -> None:
    options = ("--lcm", "--url", lcm_url()) if side == "lcm" else ("--connect", free_endpoint())
    if side == "zenoh":
        options = ("--connect", publisher.endpoint)
    with recording(tmp_path / "walk", *options) as record:
        record.wait_for(problem)
        ended = record.end(signal.SIGINT if side else None)
    assert ended.status == 1
    if side:
        assert names(ended.stdout, "nothing", "no file")
    assert {path.name for path in tmp_path.iterdir()} == {"stderr"}


HANGING: Final = """
import sys, threading
from gateway.tools.cli.main import main
from gateway.client.recorder import TakeRecording
from gateway.takes.files.writer_thread import LogFile

def hang(*_):
    print("the disk hangs", file=sys.stderr, flush=True)
    threading.Event().wait()

def stop(recording, stop=TakeRecording.stop):
    print("it ends", file=sys.stderr, flush=True)
    stop(recording)

LogFile.append, TakeRecording.stop = hang, stop
main()
"""


def test_a_second_ctrl_c_ends_at_once_although_the_disk_hangs(tmp_path: Path, publisher: Publisher) -> None:
    with recording_of(publisher, tmp_path / "walk", command=(sys.executable, "-c", HANGING)) as record:
        publisher.publish("lab", *range(10))
        record.wait_for("the disk hangs")
        record.process.send_signal(signal.SIGINT)
        record.wait_for("it ends")
        assert record.process.poll() is None
        assert record.end().status == 130
