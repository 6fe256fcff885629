"""``rtc3d-gateway record`` as a program of its own, beside gateways and publishers on real Zenoh and LCM."""

import os
import pty
import re
import resource
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import rtc3d
import yaml
import zenoh

from gateway.messages.decode import decode, prefix_of
from gateway.messages.stamp import PREFIX
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.subscriber.series import FINGERPRINTS
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader
from tests.gateway_process import PROGRAM, program, simulator
from tests.networks import free_endpoint, lcm_url, open_zenoh, zenoh_keys
from tests.waiting import wait_until

pytestmark = pytest.mark.netns

SCENE: Final = ("--rate", "100", "--analog-rate", "500", "--markers", "20", "--analog", "8")
COMPONENTS: Final = ("3d", "6d", "analog", "force", "event")


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


class Lab(NamedTuple):
    """A gateway process with the source Lab-1. ``published`` is what another subscriber got, by channel."""

    options: tuple[str, ...]
    published: dict[str, list[bytes]]
    start: Callable[[], None]
    stop: Callable[[], None]


@contextmanager
def lab(tmp_path: Path, side: str, *scene: str, **source: Any) -> Iterator[Lab]:
    endpoint, url = free_endpoint(), lcm_url()
    published: defaultdict[str, list[bytes]] = defaultdict(list)

    def receive_zenoh(sample: zenoh.Sample) -> None:
        path = str(sample.key_expr).split("/", 2)[2]
        label = path.removeprefix("6d/").replace("%20", " ")
        names = ("6d", label) if path.startswith("6d/") else (path,)
        published[lcm_channel("MOCAP", "Lab-1", *names)].append(sample.payload.to_bytes())

    with ExitStack() as stack:
        port, _ = stack.enter_context(simulator("--tools", "2", *SCENE, *scene))
        configuration = {
            "sources": [{"name": "Lab-1", "host": "127.0.0.1", "port": port, **source}],
            "zenoh": {
                "enabled": side == "zenoh",
                "tool_poses": True,
                "config": zenoh_keys("peer", listen=endpoint),
            },
            "lcm": {"enabled": side == "lcm", "tool_poses": True, "url": url},
            "metrics": {"enabled": False},
        }
        (tmp_path / "gateway.yaml").write_text(yaml.safe_dump(configuration))

        running: list[Any] = []

        def start() -> None:
            gateway = program("run", "--config", str(tmp_path / "gateway.yaml"), stderr=subprocess.DEVNULL)
            running.append(stack.enter_context(gateway))

        def stop() -> None:
            process = running.pop()
            process.kill()
            process.wait()

        start()
        if side == "zenoh":
            session = wait_for_zenoh(endpoint)
            stack.callback(session.close)
            session.declare_subscriber("mocap/Lab-1/**", receive_zenoh)
            options: tuple[str, ...] = ("--connect", endpoint)
        else:
            subscriber = LcmSubscriber(
                open_lcm(receiving_url(url)),
                "MOCAP_.+",
                lambda channel, data: published[channel].append(data),
            )
            stack.callback(subscriber.close)
            options = ("--lcm", "--url", url)
        wait_until(lambda: len(published[lcm_channel("MOCAP", "Lab-1", "3d")]) > 10)
        yield Lab(options, published, start, stop)


def wait_for_zenoh(endpoint: str) -> zenoh.Session:
    deadline_s = time.monotonic() + 30
    while True:
        try:
            return open_zenoh("client", connect=endpoint)
        except zenoh.ZError:
            assert time.monotonic() < deadline_s


def assert_same_bytes(path: Path, published: dict[str, list[bytes]]) -> None:
    """The file has every message from its first one to its last one, with the bytes that were published."""
    recorded = by_channel(path)
    for name in (*COMPONENTS, "status", "clock", "6d_TOOL_1", "6d_TOOL_2"):
        channel = f"MOCAP_LAB_1_{name.upper()}"
        messages = recorded[channel]
        assert messages, name
        start = published[channel].index(messages[0])
        wait_until(lambda: len(published[channel]) >= start + len(messages))  # noqa: B023
        assert published[channel][start : start + len(messages)] == messages


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_a_recording_has_what_was_published_and_begins_with_its_description(
    tmp_path: Path, side: str
) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, side) as gateway, recording(tmp_path, str(path), *gateway.options) as record:
        wait_until(lambda: size(path) > 500_000)
        ended = record.end(signal.SIGTERM)
        assert_same_bytes(path, gateway.published)
    assert ended.status == 0, ended
    assert f"{path}: " in ended.stdout
    assert ended.stdout.endswith("complete: no gaps\n")
    for row in (*COMPONENTS, r"6d/\*", "status", "clock"):
        assert re.search(rf"^Lab-1 +{row} +\d+ .* Hz +- +- +-$", ended.stdout, re.MULTILINE), row
    (take_channel, take_message), (parameters_channel, parameters_message), *_ = events(path)
    take, parameters = decode(take_message), decode(parameters_message)
    assert (take_channel, parameters_channel) == ("MOCAP_LAB_1_TAKE", "MOCAP_LAB_1_PARAMETERS")
    assert (take.name, take.source, take.channels) == ("walk", "Lab-1", "MOCAP_LAB_1")
    assert take.server.startswith("127.0.0.1:")
    assert take.gateway_version
    assert "Marker" in parameters.xml
    assert parameters.parameters_version == 1
    assert len(by_channel(path)["MOCAP_LAB_1_PARAMETERS"]) == 1
    assert {message.source for message in TakeReader(path).messages()} == {"Lab-1"}


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_parameters_are_recorded_when_they_change_and_before_the_frames_they_describe(
    tmp_path: Path, side: str
) -> None:
    path = tmp_path / "walk.lcmlog"
    # The parameters on LCM are repeated every 5 s.
    with (
        lab(tmp_path, side, "--fault", "rename,every_s=3,for_s=1.5", parameters_interval_s=0.3) as gateway,
        recording(tmp_path, str(path), *gateway.options) as record,
    ):
        wait_until(lambda: size(path) and path.read_bytes().count(b"MOCAP_LAB_1_PARAMETERS") > 3, 60)
        assert record.end().status == 0
    version, known = 0, {}
    for _, message in events(path)[1:]:
        match decode(message):
            case rtc3d.parameters_t() as parameters:
                assert parameters.parameters_version == version + 1 or not version
                version = parameters.parameters_version
                known[version] = "New" in parameters.xml
            case rtc3d.markers_t() as markers:
                assert markers.parameters_version in known
    assert {*known.values()} == {True, False}


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_kill_9_costs_at_most_the_last_second(tmp_path: Path, side: str) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, side) as gateway, recording(tmp_path, str(path), *gateway.options) as record:
        wait_until(lambda: size(path) > 600_000)
        killed_utime = prefix_of(gateway.published["MOCAP_LAB_1_3D"][-1]).utime
        record.process.kill()
        record.process.wait()
    reader = EventLogReader(path)
    found = [event for event in reader.events() if event.channel == "MOCAP_LAB_1_3D"]
    # More than the second promised, for a busy computer; less than what a full buffer would take.
    assert found[-1].utime > killed_utime - 3_000_000
    assert reader.num_damaged <= 1
    assert all(damage.offset + damage.num_bytes == size(path) for damage in reader.damage)
    sequences = [prefix_of(event.message).sequence for event in found]
    assert sequences == [*range(sequences[0], sequences[0] + len(sequences))]


def set_largest_file(process: subprocess.Popen[str], num_bytes: int) -> None:
    _, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (num_bytes, hard))


def test_a_full_disk_is_reported_at_once_and_costs_nothing_if_it_has_room_again(tmp_path: Path) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, "zenoh") as gateway, recording(tmp_path, str(path), *gateway.options) as record:
        set_largest_file(record.process, 300_000)
        wait_until(lambda: f"{path} cannot be written: File too large" in record.stderr)
        set_largest_file(record.process, resource.RLIM_INFINITY)
        wait_until(lambda: "the disk accepts what is written again" in record.stderr)
        wait_until(lambda: size(path) > 600_000)
        ended = record.end()
        assert_same_bytes(path, gateway.published)
    assert ended.status == 0, ended
    assert "the disk did not accept what was written for a while (once)" in ended.stdout


def test_what_does_not_fit_on_the_disk_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, "zenoh") as gateway, recording(tmp_path, str(path), *gateway.options) as record:
        set_largest_file(record.process, 300_000)
        wait_until(lambda: "File too large" in record.stderr)
        ended = record.end()
    assert ended.status == 1
    assert re.search(r"^\d+ messages were not written: .*: File too large$", ended.stdout, re.MULTILINE)
    assert re.search(r"^Lab-1 +3d .* Hz +- +- +[1-9]\d*$", ended.stdout, re.MULTILINE)
    assert events(path)


def test_the_first_messages_are_recorded_with_the_seconds_given(tmp_path: Path) -> None:
    (tmp_path / "takes").mkdir()
    with (
        lab(tmp_path, "zenoh") as gateway,
        recording(
            tmp_path, str(tmp_path / "takes"), "--seconds", "2", "--component", "3d", *gateway.options
        ) as record,
    ):
        ended = record.end(None)
    assert ended.status == 0
    [path] = (tmp_path / "takes").iterdir()
    assert re.fullmatch(r"Lab-1-\d{8}-\d{6}\.lcmlog", path.name)
    recorded = by_channel(path)
    assert recorded.keys() == {"MOCAP_LAB_1_TAKE", "MOCAP_LAB_1_PARAMETERS", "MOCAP_LAB_1_3D"}
    utimes = [prefix_of(message).utime for message in recorded["MOCAP_LAB_1_3D"]]
    assert 1.5e6 < utimes[-1] - utimes[0] < 10e6  # on a busy computer, the end comes late


def test_a_restart_of_the_gateway_is_told_from_loss(tmp_path: Path) -> None:
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, "lcm") as gateway, recording(tmp_path, str(path), *gateway.options) as record:
        wait_until(lambda: num_recorded(path, "MOCAP_LAB_1_STATUS") >= 1)
        gateway.stop()
        wait_until(lambda: "Lab-1: nothing has arrived for 2 s" in record.stderr)
        before = num_recorded(path, "MOCAP_LAB_1_STATUS")
        gateway.start()
        wait_until(lambda: num_recorded(path, "MOCAP_LAB_1_STATUS") >= before + 2)
        ended = record.end()
    assert ended.status == 0, ended
    assert "Lab-1: its gateway was started again (once)" in ended.stdout


# A publisher of the test, which can do what a gateway does not -----------------------------


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


def test_a_source_that_appears_later_is_described_then(tmp_path: Path, publisher: Publisher) -> None:
    path = tmp_path / "walk.lcmlog"
    with recording_of(publisher, tmp_path) as record:
        publisher.publish("lab", *range(10))
        wait_until(lambda: size(path))
        publisher.publish("robot", *range(10))
        publisher.publish("lab", *range(10, 20))
        wait_until(lambda: b"MOCAP_ROBOT_3D" in path.read_bytes())
        assert record.end().status == 0
    channels = [channel for channel, _ in events(path)]
    assert channels[0] == "MOCAP_LAB_TAKE"
    assert channels[channels.index("MOCAP_ROBOT_3D") - 1] == "MOCAP_ROBOT_TAKE"


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
