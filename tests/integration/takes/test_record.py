"""``record`` beside gateways on real Zenoh and LCM: what it writes, with a full disk and a restart, too."""

import re
import resource
import signal
import subprocess
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
from gateway.messages.topics import lcm_channel
from gateway.outputs.lcm.connection import open_lcm, receiving_url
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader
from tests.gateway_process import program, simulator
from tests.integration.takes.record_process import by_channel, events, num_recorded, recording, size
from tests.networks import free_endpoint, lcm_url, wait_for_zenoh, zenoh_keys
from tests.waiting import wait_until

pytestmark = pytest.mark.netns

SCENE: Final = ("--rate", "100", "--analog-rate", "500", "--markers", "20", "--analog", "8")
COMPONENTS: Final = ("3d", "6d", "analog", "force", "event")


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


def test_kill_9_costs_at_most_the_last_second(tmp_path: Path) -> None:
    """What the thread has written is in the file, without any end of the program."""
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, "zenoh") as gateway, recording(tmp_path, str(path), *gateway.options) as record:
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
    assert 0.5e6 < utimes[-1] - utimes[0] < 30e6  # on a busy computer, the end comes late


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
