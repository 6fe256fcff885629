import time
from pathlib import Path

import pytest
import rtc3d

from gateway.errors import TakeError
from gateway.messages.decode import decode
from gateway.messages.encode import MESSAGE_TYPES
from gateway.messages.stamp import PREFIX
from gateway.recorder.file_sink import FileSink
from gateway.recorder.series import RecordedSeries, RecordedSource
from gateway.recorder.take_recording import TakeRecording
from gateway.recorder.target import Target
from gateway.rtc3d.components import ComponentType
from gateway.subscriber.reception import MAX_SERIES, MAX_SOURCES
from gateway.subscriber.series import FINGERPRINTS
from gateway.takes.event_log import EventLogReader
from gateway.takes.reader import TakeReader
from tests.waiting import wait_until

UTIME = 1_700_000_000_000_000
MARKERS = MESSAGE_TYPES[ComponentType.MARKERS]


def markers(sequence: int, version: int = 1) -> bytes:
    utime = UTIME + 5000 * sequence
    return FINGERPRINTS["3d"] + PREFIX.pack(utime, utime, sequence, 1, version) + bytes(16)


def status(source: str, sequence: int = 0) -> bytes:
    message = rtc3d.status_t()
    message.utime = UTIME
    message.sequence, message.session = sequence, 1
    message.source, message.server, message.gateway_version = source, "192.0.2.7:3020", "0.0.9"
    encoded: bytes = message.encode()
    return encoded


class Recorded:
    """A recording on a file in a folder."""

    def __init__(self, folder: Path, *components: str) -> None:
        self.path = folder / "walk.lcmlog"
        target = Target(self.path)
        self.opened: list[list[str]] = []

        def open_file(sources: list[str]) -> FileSink:
            self.opened.append(sources)
            return FileSink(target.open(sources))

        self.recording = TakeRecording(open_file, components or None)

    def source(self, name: str) -> RecordedSource:
        source = self.recording.source(name, f"MOCAP_{name.upper().replace('-', '_')}", is_known=True)
        assert source is not None
        return source

    def series(self, name: str, key: str) -> RecordedSeries:
        source = self.source(name)
        series = self.recording.series(source, key, f"{source.channels}_{key.upper()}")
        assert series is not None
        return series

    def receive(self, name: str, key: str, *messages: bytes) -> None:
        for message in messages:
            self.recording.receive(self.series(name, key), message)

    def parameters(self, name: str, xml: bytes, version: int) -> bytes:
        return self.recording.parameters_message(self.source(name), xml, 1, version)

    def publish_parameters(self, name: str, xml: bytes, version: int) -> None:
        message = self.parameters(name, xml, version)
        self.recording.receive_parameters(self.series(name, "parameters"), message, is_made=True)

    def describe(self, name: str) -> None:
        """Let a source have everything that its description needs."""
        self.recording.answered_status(self.source(name), status(name))
        self.recording.answered(self.source(name), self.parameters(name, b"<a/>", 1))
        self.receive(name, "status", status(name))
        self.recording.tick()

    def events(self) -> list[tuple[str, bytes]]:
        """End the recording and return what is in the file."""
        self.recording.stop()
        assert self.recording.close(10)
        return [(event.channel, event.message) for event in EventLogReader(self.path).events()]

    def channels(self) -> list[str]:
        return [channel for channel, _ in self.events()]


@pytest.fixture
def recorded(tmp_path: Path) -> Recorded:
    return Recorded(tmp_path)


def test_the_file_begins_with_the_description_although_messages_came_first(recorded: Recorded) -> None:
    recorded.receive("lab", "3d", *map(markers, range(40, 50)))
    recorded.recording.tick()
    assert recorded.recording.sink is None
    recorded.recording.answered(recorded.source("lab"), recorded.parameters("lab", b"<b/>", 7))
    recorded.recording.answered_status(recorded.source("lab"), status("lab"))
    recorded.recording.tick()
    recorded.receive("lab", "3d", markers(50))
    events = recorded.events()
    assert [channel for channel, _ in events] == [
        "MOCAP_LAB_TAKE",
        "MOCAP_LAB_PARAMETERS",
        *["MOCAP_LAB_3D"] * 11,
    ]
    assert [message for _, message in events[2:]] == [*map(markers, range(40, 51))]
    take, parameters = (decode(message) for _, message in events[:2])
    assert (take.name, take.source, take.channels) == ("walk", "lab", "MOCAP_LAB")
    assert (take.server, take.gateway_version) == ("192.0.2.7:3020", "0.0.9")
    assert take.utime == parameters.utime == UTIME + 5000 * 40
    assert (parameters.parameters_version, parameters.session, parameters.xml) == (7, 1, "<b/>")


def test_parameters_are_written_when_they_change_only(recorded: Recorded) -> None:
    recorded.describe("lab")
    for xml, version in ((b"<a/>", 1), (b"<a/>", 1), (b"<b/>", 2), (b"<b/>", 2), (b"<a/>", 3), (b"", 4)):
        recorded.publish_parameters("lab", xml, version)
        recorded.receive("lab", "3d", markers(version, version))
    found = [decode(message) for _, message in recorded.events()]
    kinds = [
        (each.parameters_version, each.xml)
        if isinstance(each, rtc3d.parameters_t)
        else each.parameters_version
        for each in found
        if isinstance(each, rtc3d.parameters_t | rtc3d.markers_t)
    ]
    assert kinds == [(1, "<a/>"), 1, 1, (2, "<b/>"), 2, 2, (3, "<a/>"), 3, (4, ""), 4]


def test_parameters_that_change_before_the_description_stay_in_order(recorded: Recorded) -> None:
    recorded.publish_parameters("lab", b"<a/>", 1)
    recorded.receive("lab", "3d", markers(1, 1))
    recorded.publish_parameters("lab", b"<b/>", 2)
    recorded.receive("lab", "3d", markers(2, 2))
    recorded.recording.answered(recorded.source("lab"), recorded.parameters("lab", b"<a/>", 1))
    versions = [decode(message).parameters_version for _, message in recorded.events()[1:]]
    assert versions == [1, 1, 2, 2]


def test_all_sources_at_the_start_are_described_before_any_message(recorded: Recorded) -> None:
    recorded.source("robot")
    recorded.receive("lab", "3d", markers(1))
    recorded.describe("lab")
    assert recorded.recording.sink is None
    recorded.describe("robot")
    assert recorded.opened == [["lab", "robot"]]
    assert recorded.channels()[:4] == [
        *("MOCAP_ROBOT_TAKE", "MOCAP_ROBOT_PARAMETERS"),
        *("MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS"),
    ]


def test_a_later_source_is_described_then_and_delays_no_other(recorded: Recorded) -> None:
    recorded.describe("lab")
    recorded.receive("robot", "3d", markers(1))
    recorded.receive("lab", "3d", markers(1))
    recorded.recording.tick()
    wait_until(lambda: recorded.path.stat().st_size)
    recorded.describe("robot")
    channels = recorded.channels()
    assert channels.index("MOCAP_LAB_3D") < channels.index("MOCAP_ROBOT_TAKE")
    assert channels.index("MOCAP_ROBOT_TAKE") < channels.index("MOCAP_ROBOT_3D")


def test_a_source_without_answers_is_recorded_after_a_moment(recorded: Recorded) -> None:
    recorded.receive("lab", "3d", *map(markers, range(3)))
    deadline_s = time.monotonic() + 10
    while recorded.recording.sink is None:
        recorded.recording.tick()
        assert time.monotonic() < deadline_s
    assert recorded.channels() == ["MOCAP_LAB_TAKE", *["MOCAP_LAB_3D"] * 3]


def test_sources_whose_channels_are_equal_are_kept_apart(recorded: Recorded) -> None:
    for name in ("a-b", "a_b"):
        recorded.describe(name)
        recorded.receive(name, "3d", markers(1))
    recorded.events()
    found = {message.source for message in TakeReader(recorded.path).messages() if message.key == "3d"}
    assert found == {"a-b", "a_b"}


def test_only_the_chosen_components_are_recorded(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, "6d")
    recorded.describe("lab")
    recorded.receive("lab", "3d", markers(1))
    recorded.receive("lab", "6d/Tool 1", FINGERPRINTS["6d/"] + PREFIX.pack(UTIME, UTIME, 0, 1, 1) + bytes(45))
    assert recorded.channels() == ["MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS", "MOCAP_LAB_6D/TOOL 1"]
    assert recorded.recording.num_messages == 2  # the pose and the parameters


@pytest.mark.parametrize("message", [b"", b"x", bytes(100), markers(1)[:39], status("lab")])
def test_what_is_no_message_of_the_series_is_left_out_and_counted(recorded: Recorded, message: bytes) -> None:
    recorded.describe("lab")
    recorded.receive("lab", "3d", message)
    assert recorded.channels() == ["MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS", "MOCAP_LAB_STATUS"]
    assert recorded.recording.num_foreign == 1


def test_sources_and_keys_are_bounded(recorded: Recorded) -> None:
    found = [recorded.recording.source(f"s{number}", f"S{number}", is_known=True) for number in range(1000)]
    assert sum(source is not None for source in found) == len(recorded.recording.sources) == MAX_SOURCES
    source = found[0]
    assert source is not None
    keys = [recorded.recording.series(source, f"6d/{number}", "C") for number in range(10_000)]
    assert sum(series is not None for series in keys) == MAX_SERIES


def test_nothing_is_recorded_without_a_message(recorded: Recorded) -> None:
    recorded.source("lab")
    recorded.recording.stop()
    assert recorded.recording.close(10)
    assert recorded.opened == []


def test_a_file_that_cannot_be_created_is_an_error() -> None:
    def fail(_sources: list[str]) -> FileSink:
        raise TakeError("no permission")

    recording = TakeRecording(fail)
    source = recording.source("lab", "MOCAP_LAB", is_known=True)
    assert source is not None
    series = recording.series(source, "3d", "MOCAP_LAB_3D")
    assert series is not None
    recording.receive(series, markers(1))
    with pytest.raises(TakeError, match="no permission"):
        recording.stop()
    recording.close(1)
