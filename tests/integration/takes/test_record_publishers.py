"""``record`` with a publisher of the test, which can do what a gateway does not, and how it ends."""

import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from tests.gateway_process import PROGRAM
from tests.integration.takes.record_process import (
    Publisher,
    by_channel,
    num_recorded,
    publisher,
    recording,
    recording_of,
    size,
)
from tests.networks import free_endpoint, lcm_url, open_zenoh
from tests.waiting import wait_until

__all__ = ["publisher"]

pytestmark = pytest.mark.netns


def test_gaps_are_counted_and_shown(tmp_path: Path, publisher: Publisher) -> None:
    with recording_of(publisher, tmp_path) as record:
        publisher.publish("lab", *range(500, 600), *range(605, 700), *range(703, 720))
        wait_until(lambda: "8 messages were lost on the way" in record.stderr)
        wait_until(lambda: num_recorded(tmp_path / "walk.lcmlog", "MOCAP_LAB_3D") == 212)
        ended = record.end()
    assert ended.status == 1
    assert re.search(r"^lab +3d +212 .* 2 +8 +-$", ended.stdout, re.MULTILINE)
    assert len(by_channel(tmp_path / "walk.lcmlog")["MOCAP_LAB_3D"]) == 212
    assert ended.stdout.endswith("INCOMPLETE\n")


def test_two_gateways_with_the_same_source_are_reported(tmp_path: Path, publisher: Publisher) -> None:
    with recording_of(publisher, tmp_path) as record:
        for number in range(40):
            publisher.publish("lab", 1000 + number, 50 + number)
        wait_until(lambda: "two gateways publish the source lab" in record.stderr)
        wait_until(lambda: num_recorded(tmp_path / "walk.lcmlog", "MOCAP_LAB_3D") == 80)
        ended = record.end()
    assert ended.status == 1
    assert "two gateways publish the source lab" in ended.stdout
    assert len(by_channel(tmp_path / "walk.lcmlog")["MOCAP_LAB_3D"]) == 80


def test_hostile_publishers_are_bounded(tmp_path: Path, publisher: Publisher) -> None:
    with recording_of(publisher, tmp_path) as record:
        publisher.publish("lab", *range(10))
        for number in range(300):
            publisher.publish(f"source-{number}", 0)
        for name in (
            "lab/3d",
            "lab/status",
            "lab/parameters",
            "lab/6d/x",
            "lab/6d/x/y/z",
            "l%b/3d",
            "x" * 200,
        ):
            for payload in (b"", b"\x1b[2J", bytes(1000)):
                publisher.session.put(f"mocap/{name}", payload, attachment=b"[[[")
        publisher.publish("lab", 2**62, -(2**63), 10)
        publisher.publish("lab", 1, key="analog")
        wait_until(lambda: num_recorded(tmp_path / "walk.lcmlog", "MOCAP_LAB_ANALOG"))
        ended = record.end()
    assert ended.status == 1
    assert re.search(r"messages were not recorded: there are more than 64 sources", ended.stdout)
    assert re.search(r"messages on these keys or channels were not recorded", ended.stdout)
    assert "\x1b" not in ended.stdout + ended.stderr
    assert len(ended.stdout.splitlines()) < 100


def test_a_terminal_shows_the_progress_on_one_line(tmp_path: Path, publisher: Publisher) -> None:
    reading, terminal = pty.openpty()
    arguments = ("record", str(tmp_path / "walk"), "--connect", publisher.endpoint)
    with subprocess.Popen([*PROGRAM, *arguments], stdout=subprocess.DEVNULL, stderr=terminal) as process:
        publisher.wait_for_subscriber()
        publisher.publish("lab", *range(10), *range(12, 20))
        shown = ""
        while not re.search(r"\r.*\d:\d\d  2 kB  .* messages/s  .*/s  2 lost  0 kB to be written", shown):
            shown += os.read(reading, 65536).decode()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 1
    os.close(terminal)
    os.close(reading)
    assert "2 messages were lost on the way; 2 so far\r\n" in shown


# Files and ends --------------------------------------------------------------------------------


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "walk.lcmlog").write_bytes(b"precious")
    with recording(tmp_path, str(tmp_path / "walk")) as record:
        ended = record.end(None)
    assert ended.status == 1
    assert ended.stderr.startswith(f"{tmp_path}/walk.lcmlog exists already, and nothing is overwritten")
    assert (tmp_path / "walk.lcmlog").read_bytes() == b"precious"


@pytest.mark.parametrize(("side", "name"), [("zenoh", "Zenoh"), ("lcm", "LCM")])
def test_without_a_gateway_it_says_so_and_leaves_no_file(tmp_path: Path, side: str, name: str) -> None:
    session = open_zenoh("peer", listen=(endpoint := free_endpoint()))
    options = ["--connect", endpoint] if side == "zenoh" else ["--lcm", "--url", lcm_url()]
    with recording(tmp_path, str(tmp_path / "walk"), *options) as record:
        wait_until(lambda: f"no gateway found on {name}" in record.stderr)
        ended = record.end()
    session.close()
    assert ended.status == 1
    assert ended.stdout == "nothing was recorded, and there is no file: no message has arrived\n"
    assert {path.name for path in tmp_path.iterdir()} == {"stderr"}


def test_an_endpoint_where_nobody_listens_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with recording(tmp_path, str(tmp_path / "walk"), "--connect", free_endpoint()) as record:
        ended = record.end(None)
    assert ended.status == 1
    assert "no Zenoh session to tcp/" in ended.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"stderr"}


HANGING: Final = """
import sys, threading
from gateway.cli.main import main
from gateway.recorder.take_recording import TakeRecording
from gateway.takes.recording import LogFile

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
    command = (sys.executable, "-c", HANGING)
    options = (str(tmp_path / "walk"), "--connect", publisher.endpoint)
    with recording(tmp_path, *options, command=command) as record:
        publisher.wait_for_subscriber()
        publisher.publish("lab", *range(10))
        wait_until(lambda: "the disk hangs" in record.stderr)
        record.process.send_signal(signal.SIGINT)
        wait_until(lambda: "it ends" in record.stderr)
        assert record.process.poll() is None
        assert record.end().status == 130


def test_a_file_that_is_deleted_meanwhile_is_reported(tmp_path: Path, publisher: Publisher) -> None:
    path = tmp_path / "walk.lcmlog"
    with recording_of(publisher, tmp_path) as record:
        publisher.publish("lab", *range(10))
        wait_until(lambda: size(path))
        path.unlink()
        ended = record.end()
    assert ended.status == 1
    assert "the file was moved or deleted while it was recorded" in ended.stdout
