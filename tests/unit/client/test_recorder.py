"""What `record` writes: each source described before its first message; the clock is the test's."""

import re
import threading
from pathlib import Path

import pytest
import rtc3d

from gateway.client import reception, recorder
from gateway.client.history_requests import COMPLETE, HistoryAnswer, HistoryRequest
from gateway.client.recorder import FileWriter, RecordedSeries, RecordedSource, TakeRecording, Target
from gateway.client.request_timing import GRACE_S
from gateway.client.sources import FINGERPRINTS
from gateway.errors import QueryError, TakeError
from gateway.messages.decode import decode
from gateway.messages.encode import MESSAGE_TYPES, PREFIX
from gateway.messages.history import sequence_of
from gateway.messages.topics import MAX_SOURCES
from gateway.rtc3d.components import ComponentType
from gateway.takes.files.description import NO_DETAILS, TakeDetails, decoded_details
from gateway.takes.files.event_log import EventLogReader
from gateway.takes.files.reader import TakeReader
from tests.support.clocks import Clock
from tests.support.waiting import wait_until

UTIME = 1_700_000_000_000_000
MARKERS = MESSAGE_TYPES[ComponentType.MARKERS]


def markers(sequence: int, version: int = 1) -> bytes:
    utime = UTIME + 5000 * sequence
    return FINGERPRINTS["3d"] + PREFIX.pack(utime, utime, sequence, 1, version) + bytes(16)


def events(sequence: int) -> bytes:
    return FINGERPRINTS["event"] + markers(sequence)[8:]


def status(source: str, sequence: int = 0) -> bytes:
    message = rtc3d.status_t()
    message.utime, message.sequence, message.session = UTIME, sequence, 1
    message.source, message.server, message.gateway_version = source, "192.0.2.7:3020", "0.0.9"
    encoded: bytes = message.encode()
    return encoded


class Recorded:
    """A recording on a file in a folder."""

    def __init__(
        self,
        folder: Path,
        *components: str,
        clock: Clock,
        start_s: float = 0.0,
        details: TakeDetails = NO_DETAILS,
    ) -> None:
        self.path = folder / "walk.lcmlog"
        target = Target(self.path)
        self.opened: list[list[str]] = []

        def open_file(sources: list[str]) -> FileWriter:
            self.opened.append(sources)
            return FileWriter(target.open(sources))

        self.recording = TakeRecording(open_file, components or None, start_s, details, clock)

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

    def publish_parameters(self, xml: bytes, version: int) -> None:
        message = self.recording.parameters_message(self.source("lab"), xml, 1, version)
        self.recording.receive_parameters(self.series("lab", "parameters"), message, is_made=True)

    def answer_parameters(self, name: str, xml: bytes = b"<a/>", version: int = 1) -> None:
        source = self.source(name)
        self.recording.answered(source, self.recording.parameters_message(source, xml, 1, version))

    def describe(self, name: str) -> None:
        """Let a source have everything that its description needs."""
        self.recording.answered_status(self.source(name), status(name))
        self.answer_parameters(name)
        self.receive(name, "status", status(name))
        self.recording.tick()

    def events(self) -> list[tuple[str, bytes]]:
        """End the recording and return what is in the file, without the ends of the sources."""
        self.recording.stop()
        assert self.recording.close(10)
        events = [(event.channel, event.message) for event in EventLogReader(self.path).events()]
        self.ends = [decode(message) for channel, message in events if channel.endswith("_END")]
        return [event for event in events if not event[0].endswith("_END")]

    def channels(self) -> list[str]:
        return [channel for channel, _ in self.events()]


def test_series_are_refilled_side_by_side_so_that_the_file_follows_time(
    recorded: Recorded, clock: Clock
) -> None:
    """Otherwise, a replay would take the refilled messages for a clock that was set back."""
    may_answer = threading.Event()

    def ask(series: RecordedSeries, request: HistoryRequest, _timeout_s: float) -> HistoryAnswer:
        assert may_answer.wait(60)
        first = 0 if request.known is None else request.known[0]
        assert request.last is not None
        new = markers if series.key == "3d" else events
        found = [new(number) for number in range(first, request.last + 1)]
        return HistoryAnswer(found, first, request.last, 9)

    recorded.recording.complete(ask, lambda *_: [], COMPLETE)
    recorded.describe("lab")
    for number in range(10):
        if number not in range(2, 7):
            recorded.receive("lab", "3d", markers(number))
            recorded.receive("lab", "event", events(number))
    clock.now_s += GRACE_S
    may_answer.set()
    wait_until(lambda: recorded.recording.num_messages >= 21)
    numbers = [
        (sequence_of(data), name) for name, data in recorded.events() if name.endswith(("3D", "EVENT"))
    ]
    assert sorted(numbers) == [
        (number, f"MOCAP_LAB_{key}") for number in range(10) for key in ("3D", "EVENT")
    ]
    assert [number for number, _ in numbers] == sorted(number for number, _ in numbers)


def test_what_waits_for_missing_messages_does_not_keep_these_from_being_requested(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each would wait for the other until the memory is full, and everything would be out of order."""
    size = len(markers(0))
    monkeypatch.setattr(recorder, "MAX_QUEUED_BYTES", 16 * 5 * size)
    recorded.recording.complete(refuse, lambda *_: [], COMPLETE)
    recorded.describe("lab")
    wait_until(lambda: recorded.recording.queued_bytes == 0)
    recorded.receive("lab", "3d", markers(0), markers(2))
    recorded.receive("lab", "event", *map(events, range(10)))
    wait_until(lambda: recorded.recording.has_room)
    assert recorded.recording.queued_bytes >= 5 * size
    recorded.events()


def refuse(*_: object) -> HistoryAnswer:
    raise QueryError("later", code="busy")


def test_what_waits_for_missing_messages_keeps_its_order_if_the_clock_is_set_back(recorded: Recorded) -> None:
    """Readers take a number that goes back for a restart of the gateway."""
    recorded.recording.complete(refuse, lambda *_: [], COMPLETE)
    recorded.describe("lab")
    recorded.receive("lab", "3d", markers(0), markers(2))
    times = [UTIME + 10_000_000 - number for number in range(5)]
    set_back = [
        FINGERPRINTS["event"] + PREFIX.pack(utime, utime, n, 1, 1) + bytes(16)
        for n, utime in enumerate(times)
    ]
    recorded.receive("lab", "event", *set_back)
    assert [message for name, message in recorded.events() if name.endswith("EVENT")] == set_back


def test_what_the_end_of_the_file_costs_is_counted_once(recorded: Recorded) -> None:
    """The ends of the sources need room on a full disk, for which the newest message is removed."""
    for name in ("lab", "hall"):
        recorded.describe(name)
    assert recorded.recording.file is not None
    ends = [decode(message) for _, message in recorded.recording._ends(recorded.recording.file, 1)]
    assert sorted(end.messages_lost for end in ends) == [0, 1]
    recorded.events()


@pytest.fixture
def clock() -> Clock:
    """The monotonic clock of everything that is received and recorded."""
    return Clock()


@pytest.fixture
def recorded(clock: Clock, tmp_path: Path) -> Recorded:
    return Recorded(tmp_path, clock=clock)


def test_the_file_begins_with_the_description_although_messages_came_first(recorded: Recorded) -> None:
    """Whoever reads the file from its beginning can label every frame."""
    recorded.receive("lab", "3d", *map(markers, range(40, 50)))
    recorded.recording.tick()
    assert recorded.recording.file is None
    recorded.answer_parameters("lab", b"<b/>", 7)
    recorded.recording.answered_status(recorded.source("lab"), status("lab"))
    recorded.recording.tick()
    recorded.receive("lab", "3d", markers(50))
    events = recorded.events()
    assert [channel for channel, _ in events[:2]] == ["MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS"]
    assert [message for _, message in events[2:]] == [*map(markers, range(40, 51))]
    take, parameters = (decode(message) for _, message in events[:2])
    assert (take.name, take.source, take.channels) == ("walk", "lab", "MOCAP_LAB")
    assert (take.server, take.gateway_version) == ("192.0.2.7:3020", "0.0.9")
    assert take.utime == parameters.utime == UTIME + 5000 * 40
    assert (parameters.parameters_version, parameters.session, parameters.xml) == (7, 1, "<b/>")


def test_each_source_has_what_the_recording_is_about(tmp_path: Path, clock: Clock) -> None:
    """The file can be split by source, as exports do."""
    about = TakeDetails("S01", "baseline", "left knee")
    recorded = Recorded(tmp_path, clock=clock, details=about)
    for name in ("lab", "hall"):
        recorded.describe(name)
    messages = dict(recorded.events())
    for name in ("lab", "hall"):
        details = decode(messages[f"MOCAP_{name.upper()}_DETAILS"])
        assert (details.source, *decoded_details(details)) == (name, *about)


def test_parameters_are_written_when_they_change_only(recorded: Recorded) -> None:
    """LCM repeats them every 5 s; a change back is a change."""
    recorded.describe("lab")
    for xml, version in ((b"<a/>", 1), (b"<a/>", 1), (b"<b/>", 2), (b"<b/>", 2), (b"<a/>", 3), (b"", 4)):
        recorded.publish_parameters(xml, version)
        recorded.receive("lab", "3d", markers(version, version))
    found = [decode(message) for _, message in recorded.events()[1:]]
    written = [(getattr(each, "xml", None), each.parameters_version) for each in found[:1] + found[2:]]
    assert written == [
        *(("<a/>", 1), (None, 1), (None, 1), ("<b/>", 2), (None, 2), (None, 2)),
        *(("<a/>", 3), (None, 3), ("", 4), (None, 4)),
    ]


def test_parameters_that_change_before_the_description_stay_in_order(recorded: Recorded) -> None:
    """Each frame has the parameters before it that were valid then."""
    for xml, version in ((b"<a/>", 1), (b"<b/>", 2)):
        recorded.publish_parameters(xml, version)
        recorded.receive("lab", "3d", markers(version, version))
    recorded.answer_parameters("lab")
    versions = [decode(message).parameters_version for _, message in recorded.events()[1:]]
    assert versions == [1, 1, 2, 2]


def test_all_sources_at_the_start_are_described_before_any_message(recorded: Recorded) -> None:
    """The head of the file tells what is in it."""
    recorded.source("robot")
    recorded.receive("lab", "3d", markers(1))
    recorded.describe("lab")
    assert recorded.recording.file is None
    recorded.describe("robot")
    assert recorded.opened == [["lab", "robot"]]
    assert recorded.channels()[:4] == [
        *("MOCAP_ROBOT_TAKE", "MOCAP_ROBOT_PARAMETERS"),
        *("MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS"),
    ]


def test_a_later_source_is_described_then_and_delays_no_other(recorded: Recorded) -> None:
    """A gateway may be started in the middle of a recording."""
    recorded.describe("lab")
    recorded.receive("robot", "3d", markers(1))
    recorded.receive("lab", "3d", markers(1))
    recorded.recording.tick()
    wait_until(lambda: recorded.path.stat().st_size)
    recorded.describe("robot")
    channels = recorded.channels()
    assert channels.index("MOCAP_LAB_3D") < channels.index("MOCAP_ROBOT_TAKE")
    assert channels.index("MOCAP_ROBOT_TAKE") < channels.index("MOCAP_ROBOT_3D")


@pytest.mark.parametrize("after_s", [0.0, 1.5, 1.6])
def test_a_source_without_answers_is_recorded_soon(recorded: Recorded, clock: Clock, after_s: float) -> None:
    """An old gateway answers no query, and its messages must not wait for ever."""
    recorded.receive("lab", "3d", *map(markers, range(3)))
    clock.now_s += after_s
    recorded.recording.tick()
    assert (recorded.recording.file is not None) is (after_s > 1.5)
    assert recorded.channels() == ["MOCAP_LAB_TAKE", *["MOCAP_LAB_3D"] * 3]


def test_the_file_is_created_after_the_time_in_which_sources_are_found(tmp_path: Path, clock: Clock) -> None:
    """Its name has the names of all sources, so it waits for those that answer later."""
    recorded = Recorded(tmp_path, clock=clock, start_s=2.0)
    recorded.describe("lab")
    clock.now_s += 1.9
    recorded.describe("robot")
    assert recorded.recording.file is None
    clock.now_s += 0.1
    recorded.recording.tick()
    assert recorded.opened == [["lab", "robot"]]
    recorded.events()


def test_what_waits_for_descriptions_is_bounded(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """A source that is never described must not take all memory; what is refused is counted."""
    monkeypatch.setattr(recorder, "MAX_QUEUED_BYTES", 3 * len(markers(0)))
    recorded.receive("lab", "3d", *map(markers, range(5)))
    assert recorded.series("lab", "3d").num_refused == 2
    assert recorded.recording.queued_bytes == 3 * len(markers(0))
    recorded.describe("lab")
    recorded.receive("robot", "3d", *map(markers, range(5)))
    assert recorded.series("robot", "3d").num_refused == 2
    assert recorded.series("robot", "3d").num_refused_bytes == 2 * len(markers(0))
    recorded.describe("robot")
    channels = recorded.channels()
    assert (channels.count("MOCAP_LAB_3D"), channels.count("MOCAP_ROBOT_3D")) == (3, 3)
    assert recorded.recording.queued_bytes == 0


def test_parameters_of_an_answer_have_times_on_the_clock_of_the_gateway(recorded: Recorded) -> None:
    """The clock of this computer may differ by hours, and the answer says only how old they are."""
    recorded.receive("lab", "3d", markers(2))
    make, source = recorded.recording.parameters_message, recorded.source("lab")
    first, second = (decode(make(source, b"<a/>", session, 4, age_s=2.5)) for session in (None, 7))
    assert (first.utime, first.capture_utime) == (UTIME + 10_000, UTIME + 10_000 - 2_500_000)
    assert [(each.sequence, each.session) for each in (first, second)] == [(0, 1), (1, 7)]
    recorded.events()


def test_sources_whose_channels_are_equal_are_kept_apart(recorded: Recorded) -> None:
    """Channels know no hyphen, so two names can be one channel."""
    for name in ("a-b", "a_b"):
        recorded.describe(name)
        recorded.receive(name, "3d", markers(1))
    recorded.events()
    found = {message.source for message in TakeReader(recorded.path).messages() if message.key == "3d"}
    assert found == {"a-b", "a_b"}


def test_only_the_chosen_components_are_recorded(tmp_path: Path, clock: Clock) -> None:
    """The parameters are always recorded: they say what the rest means."""
    recorded = Recorded(tmp_path, "6d", clock=clock)
    recorded.describe("lab")
    recorded.receive("lab", "3d", markers(1))
    recorded.receive("lab", "6d/Tool 1", FINGERPRINTS["6d/"] + PREFIX.pack(UTIME, UTIME, 0, 1, 1) + bytes(45))
    assert recorded.channels() == ["MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS", "MOCAP_LAB_6D/TOOL 1"]
    assert recorded.recording.num_messages == 2  # the pose and the parameters


@pytest.mark.parametrize("message", [b"", b"x", bytes(100), markers(1)[:39], status("lab")])
def test_what_is_no_message_of_the_series_is_left_out_and_counted(recorded: Recorded, message: bytes) -> None:
    """Anybody can publish on these keys."""
    recorded.describe("lab")
    recorded.receive("lab", "3d", message)
    assert recorded.channels() == ["MOCAP_LAB_TAKE", "MOCAP_LAB_PARAMETERS", "MOCAP_LAB_STATUS"]
    assert recorded.recording.num_foreign == 1


def test_sources_and_keys_are_bounded(recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names come from the network and must not fill the memory."""
    monkeypatch.setattr(reception, "MAX_SERIES", 50)
    found = [recorded.recording.source(f"s{number}", f"S{number}", is_known=True) for number in range(300)]
    sources = [source for source in found if source is not None]
    assert len(sources) == len(recorded.recording.sources) == MAX_SOURCES
    keys = [(source, f"6d/{number}") for source in sources[:2] for number in range(40)]
    assert [bool(recorded.recording.series(source, key, "C")) for source, key in keys].count(True) == 50


def test_nothing_is_recorded_without_a_message(recorded: Recorded) -> None:
    """A recording that found nothing leaves no file."""
    recorded.source("lab")
    recorded.recording.stop()
    assert recorded.recording.close(10)
    assert recorded.opened == []


def test_a_file_that_cannot_be_created_is_an_error(recorded: Recorded) -> None:
    """The user learns it at the end, too."""

    def fail(_sources: list[str]) -> FileWriter:
        raise TakeError("no permission")

    recorded.recording = TakeRecording(fail)
    recorded.receive("lab", "3d", markers(1))
    with pytest.raises(TakeError, match="no permission"):
        recorded.recording.stop()
    recorded.recording.close(1)


# The name of the file --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sources", "expected"),
    [
        (["lab"], "lab"),
        (["lab", "robot", "Hand-2"], r"lab\+robot\+Hand-2"),
        (["a", "b", "c", "d"], "4-sources"),
    ],
)
def test_a_name_in_a_folder_follows_the_sources(tmp_path: Path, sources: list[str], expected: str) -> None:
    first, second = (Target(tmp_path).open(sources).path.name for _ in range(2))
    assert re.fullmatch(expected + r"-\d{8}-\d{6}\.lcmlog", first)
    assert re.fullmatch(expected + r"-\d{8}-\d{6}(-2)?\.lcmlog", second)
    assert first != second


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("there.lcmlog", "there.lcmlog exists already"),
        ("there", "there.lcmlog exists already"),
        ("dangling.lcmlog", "exists already"),
        ("nowhere/walk.lcmlog", ".*nowhere; create"),
        ("there.lcmlog/walk.lcmlog", "there.lcmlog/walk.lcmlog .*Not a directory"),
        ("walk.mcap", r"\.lcmlog"),
        ("x" * 300, ".*File name too long"),
    ],
)
def test_what_cannot_be_a_new_file_is_an_error(tmp_path: Path, name: str, problem: str) -> None:
    (tmp_path / "there.lcmlog").write_bytes(b"precious")
    (tmp_path / "dangling.lcmlog").symlink_to("elsewhere")
    with pytest.raises(TakeError, match=problem):
        Target(tmp_path / name)
    assert (tmp_path / "there.lcmlog").read_bytes() == b"precious"
    assert {path.name for path in tmp_path.iterdir()} == {"there.lcmlog", "dangling.lcmlog"}


def test_a_file_gets_the_extension_and_is_removed_if_it_remains_empty(tmp_path: Path) -> None:
    targets = [Target(tmp_path / name) for name in ("walk", "run.lcmlog", "full")]
    assert {path.name for path in tmp_path.iterdir()} == {"walk.lcmlog", "run.lcmlog", "full.lcmlog"}
    targets[2].open([]).append([(b"MOCAP_LAB_3D", bytes(40))])
    for target in targets:
        target.discard_empty()
    assert {path.name: path.stat().st_size for path in tmp_path.iterdir()} == {"full.lcmlog": 28 + 12 + 40}
