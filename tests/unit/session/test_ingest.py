"""Batches of frames that reach an ingest whose clock has learned for three seconds."""

import numpy as np
import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.messages.encode import Stamp
from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, ComponentType, encode_component
from gateway.rtc3d.frames import RawFrame, encode_frame, split_frame
from gateway.session.ingest import Ingest
from gateway.session.status import SKIPPED, StreamStatus
from tests.support.errors import names
from tests.support.statuses import amounts

BOOT_UTIME = 1_700_000_000_000_000
PERIOD_US = 5_000
RATE_HZ = 200
DTYPES = ITEM_DTYPES | {ComponentType.EVENT: LONG_EVENT}
MARKERS, EVENT = ComponentType.MARKERS, ComponentType.EVENT


def frame(number: int, *, event: bool = False) -> RawFrame:
    """Return frame ``number`` with one marker and, if requested, an event."""
    return frame_of(number, *((MARKERS, number), (EVENT, number)) if event else ((MARKERS, number),))


def frame_of(tick: int, *numbered: tuple[ComponentType, int]) -> RawFrame:
    """Return the frame of period ``tick`` with these components, each with its own frame number."""
    components = [
        encode_component(
            component,
            number,
            PERIOD_US * tick,
            np.zeros(1, LONG_EVENT if component is EVENT else ITEM_DTYPES[component]),
        )
        for component, number in numbered
    ]
    return split_frame(encode_frame(components), "big")


class Lab:
    """An ingest; ``published`` and ``skipped`` are the frame numbers and component keys it passed on."""

    def __init__(self, backlog: str, *components: str, adapt_rate: bool = True) -> None:
        self.backlog = backlog
        self.status = StreamStatus("3d event", name="lab (3d event)")
        self.published: list[tuple[int, list[str]]] = []
        self.skipped: list[tuple[int, list[str]]] = []
        self.stamps: list[Stamp] = []
        self.halvings: list[int] = []
        self.restarts = 0
        self.set_by_us = 0
        """How far somebody has set the wall clock forward."""
        stream = StreamSettings.model_validate(
            {"components": components or ["all"], "backlog": backlog, "adapt_rate": adapt_rate}
        )
        self._stream = stream
        self.connect()

    def connect(self) -> None:
        """Begin a session."""
        self.ingest = Ingest(
            SourceSettings(name="lab", host="127.0.0.1"),
            self._stream,
            self.status,
            self._publish,
            self._skip,
            self.halvings.append,
            self._on_restart,
        )

    def _on_restart(self) -> None:
        self.restarts += 1

    def _publish(self, frame: RawFrame, stamp: Stamp, wanted: frozenset[ComponentType]) -> None:
        self.stamps.append(stamp)
        self._add(self.published, frame, wanted)

    def _skip(self, frame: RawFrame, stamp: Stamp, components: frozenset[ComponentType]) -> int:
        assert stamp is self.stamps[-1]
        return self._add(self.skipped, frame, components)

    @staticmethod
    def _add(numbers: list[tuple[int, list[str]]], frame: RawFrame, types: frozenset[ComponentType]) -> int:
        keys = [component.type.key for component in frame.components if component.type in types]
        if keys:
            numbers.append((frame.components[0].frame_number, keys))
        return len(keys)

    def receive(self, *frames: RawFrame, late_us: int = 0) -> None:
        """Receive the frames together, ``late_us`` after the newest was captured."""
        self.receive_at(BOOT_UTIME + frames[-1].components[0].timestamp_us + late_us, *frames)

    def receive_at(self, utime: int, *frames: RawFrame) -> None:
        self.ingest.receive(list(frames), utime + self.set_by_us, utime - BOOT_UTIME)


@pytest.fixture(params=["latest", "all"])
def lab(request: pytest.FixtureRequest) -> Lab:
    return learned_lab(request.param)


def learned_lab(backlog: str, *components: str) -> Lab:
    """Return a lab whose clock has learned for three seconds."""
    lab = Lab(backlog, *components)
    for number in range(3 * RATE_HZ):
        lab.receive(frame(number))
    assert [number for number, _ in lab.published] == list(range(600))
    lab.published.clear()
    lab.stamps.clear()
    return lab


def test_capture_time_is_the_servers_time_on_the_hosts_clock(lab: Lab) -> None:
    lab.receive(frame(600), late_us=20_000)
    [stamp] = lab.stamps
    assert stamp.utime == lab.status.last_frame_utime == BOOT_UTIME + 600 * PERIOD_US + 20_000
    assert stamp.capture_utime == pytest.approx(BOOT_UTIME + 600 * PERIOD_US, abs=500)
    assert lab.status.lag_s == pytest.approx(0.02, abs=0.001)


def test_frames_that_arrive_together_but_in_time_are_all_published(lab: Lab) -> None:
    lab.receive(*(frame(number) for number in range(600, 605)))
    assert [number for number, _ in lab.published] == list(range(600, 605))
    assert not lab.status.losses.report()


def test_while_late_the_newest_is_published_and_no_event_is_skipped(lab: Lab) -> None:
    late = [frame(number, event=number == 602) for number in range(600, 605)]
    lab.receive(*late, late_us=200_000)
    if lab.backlog == "latest":
        assert lab.published == [(602, ["event"]), (604, ["3d"])]
        assert amounts(lab.status.losses.report()) == {SKIPPED: (4, 4)}
    else:
        assert [number for number, _ in lab.published] == list(range(600, 605))
        assert not lab.status.losses.report()


EMPTY = split_frame(encode_frame([]), "big")
FORCE, TOOLS = ComponentType.FORCE, ComponentType.TOOLS


@pytest.mark.parametrize("last", [(EMPTY,), (EMPTY, EMPTY), (frame_of(603, (FORCE, 603)),)])
def test_while_late_the_newest_frame_that_is_not_empty_is_published(last: tuple[RawFrame, ...]) -> None:
    lab = learned_lab("latest", "3d", "event")
    late = [frame(600), frame(601, event=True), frame(602)]
    lab.receive_at(BOOT_UTIME + 605 * PERIOD_US + 200_000, *late, *last)
    assert lab.published == [(601, ["event"]), (602, ["3d"])]
    assert amounts(lab.status.losses.report()) == {SKIPPED: (2, 2)}


def test_while_late_the_newest_of_each_component_is_published() -> None:
    """Servers leave out components that are empty (field note 5)."""
    lab = learned_lab("latest")
    late = [
        frame_of(600, (MARKERS, 600), (TOOLS, 600)),
        frame_of(601, (MARKERS, 601), (TOOLS, 601)),
        frame_of(602, (FORCE, 602)),
        frame_of(603, (MARKERS, 603)),
    ]
    lab.receive(*late, late_us=200_000)
    assert lab.published == [(601, ["6d"]), (602, ["force"]), (603, ["3d"])]
    assert amounts(lab.status.losses.report()) == {SKIPPED: (3, 2)}


def test_without_a_clock_a_long_batch_is_late() -> None:
    """A server without time stamps: what arrives after a stop of the process is old, except the newest."""
    lab = Lab("latest")
    lab.receive_at(BOOT_UTIME + 1, *(without_time(number) for number in range(100)))
    assert [number for number, _ in lab.published] == list(range(100))  # the clock may still be learned
    lab.receive_at(BOOT_UTIME + 4_000_000, *(without_time(number) for number in range(100, 104)))
    assert [number for number, _ in lab.published] == list(range(104))
    lab.receive_at(BOOT_UTIME + 6_000_000, *(without_time(number) for number in range(104, 504)))
    assert [number for number, _ in lab.published] == [*range(104), 503]
    assert amounts(lab.status.losses.report()) == {SKIPPED: (399, 399)}


def without_time(number: int) -> RawFrame:
    """Return frame ``number`` with the time stamp 0."""
    marker = np.zeros(1, ITEM_DTYPES[MARKERS])
    return split_frame(encode_frame([encode_component(MARKERS, number, 0, marker)]), "big")


def test_frames_that_stay_late_request_lower_rates(lab: Lab) -> None:
    for number in range(600, 600 + 2 * RATE_HZ + RATE_HZ // 10):
        lab.receive(frame(number), late_us=200_000 + 500 * (number - 600))
    assert lab.halvings == [1, 2]


def test_without_adapt_rate_lateness_is_reported_once() -> None:
    lab = Lab("all", adapt_rate=False)
    for number in range(600 + 5 * RATE_HZ):
        lab.receive(frame(number), late_us=0 if number < 600 else 200_000 + 500 * (number - 600))
    assert lab.halvings == [1]
    for number in range(600 + 5 * RATE_HZ, 600 + 16 * RATE_HZ):
        lab.receive(frame(number))
    assert lab.halvings == [1, 0]


@pytest.mark.parametrize("by_s", [0.5, -0.5, 86_400, -86_400, 200 * 86_400])
def test_a_step_of_the_hosts_clock_changes_time_stamps_and_nothing_else(lab: Lab, by_s: float) -> None:
    lab.set_by_us = round(1e6 * by_s)
    for number in range(600, 600 + 5 * RATE_HZ, 4):
        lab.receive(*(frame(each) for each in range(number, number + 4)))
    assert [number for number, _ in lab.published] == list(range(600, 600 + 5 * RATE_HZ))
    assert not amounts(lab.status.losses.report())
    assert (lab.halvings, lab.restarts) == ([], 0)
    assert lab.status.lag_s < 0.03
    for stamp, number in zip(lab.stamps, range(600, 600 + 5 * RATE_HZ), strict=True):
        captured_utime = BOOT_UTIME + lab.set_by_us + number * PERIOD_US
        assert stamp.has_clock
        assert stamp.capture_utime == pytest.approx(captured_utime, abs=500)
        assert stamp.capture_utime <= stamp.utime


def test_lateness_before_a_restart_does_not_count_after_it(lab: Lab) -> None:
    for number in range(600, 600 + RATE_HZ * 9 // 10):  # 0.9 s late: 0.1 s more would halve the rate
        lab.receive(frame(number), late_us=200_000)
    assert lab.halvings == []
    restart_utime = BOOT_UTIME + 780 * PERIOD_US + 200_000
    lab.receive_at(restart_utime, frame(0), frame(1))
    assert lab.restarts == 1
    assert [number for number, _ in lab.published][-2:] == [0, 1]  # not late: nothing is skipped
    for number in range(2, 2 + RATE_HZ * 9 // 10):
        lab.receive_at(restart_utime + number * PERIOD_US + 200_000, frame(number))
    assert lab.halvings == []


def test_a_file_in_a_loop_is_no_restart_of_the_server(lab: Lab) -> None:
    """Numbers and time stamps go back within a connection, which a restart of the server would end."""
    utime = BOOT_UTIME + 600 * PERIOD_US
    for loop in range(8):
        for number in range(100):
            lab.receive_at(utime + (100 * loop + number) * PERIOD_US, frame(number))
    assert (lab.status.restarts, lab.restarts, lab.ingest.arrivals.num_restarts) == (0, 8, 8)


@pytest.mark.parametrize(
    ("number", "after_s", "restarts"),
    [(0, 10, 1), (700, 10, 1), (600, 10, 1), (600 + 10 * RATE_HZ, 10, 0), (600 + 20 * RATE_HZ, 10, 1)],
)
def test_a_restart_of_the_server_shows_in_the_first_frame_of_a_connection(
    lab: Lab, number: int, after_s: int, restarts: int
) -> None:
    """Its numbers and time stamps may go back or forward, but not by the time that has passed."""
    lab.connect()
    utime = BOOT_UTIME + 600 * PERIOD_US + after_s * 1_000_000
    for index in range(200):
        lab.receive_at(utime + index * PERIOD_US, frame(number + index))
        [*_, stamp] = lab.stamps
        assert stamp.capture_utime == pytest.approx(stamp.utime, abs=500)
        assert lab.status.lag_s < 0.001
    assert (lab.status.restarts, lab.restarts) == (restarts, 0), "the handshake has read the parameters"


def test_frame_numbers_are_followed_for_one_component_type_only(lab: Lab) -> None:
    for tick in range(600, 610):
        lab.receive(frame_of(tick, (MARKERS, tick), (EVENT, 7)))
        lab.receive(frame_of(tick, (EVENT, 3)))  # numbered separately
    assert lab.restarts == 0


def test_frame_numbers_of_events_are_followed_until_another_type_arrives() -> None:
    lab = Lab("all")
    lab.receive(frame_of(0, (EVENT, 5000)))
    for tick in range(1, 5):
        lab.receive(frame(tick))
    # The numbers of markers took over, below those of events: that is one restart, and no further one.
    assert lab.restarts == 1
    lab.receive(frame_of(5, (EVENT, 3)))
    assert lab.restarts == 1
    lab.receive_at(BOOT_UTIME + 10 * PERIOD_US, frame_of(6, (MARKERS, 1)))
    assert lab.restarts == 2  # the markers' own numbers go back


def test_frames_without_components_are_counted_and_not_published(lab: Lab) -> None:
    before = lab.status.frames_in
    lab.receive_at(BOOT_UTIME, split_frame(encode_frame([]), "big"))
    assert lab.status.frames_in == before + 1
    assert not lab.published


def test_frames_after_one_without_components_are_published(lab: Lab) -> None:
    empty = split_frame(encode_frame([]), "big")
    lab.receive(frame(600), empty, frame(601))
    assert [number for number, _ in lab.published] == [600, 601]


def test_stamps_have_the_session_and_whether_there_is_a_clock() -> None:
    lab = Lab("all")
    lab.status.connected("192.0.2.20:3020")
    for number in range(3 * RATE_HZ):
        lab.receive(frame(number))
    first, last = lab.stamps[0], lab.stamps[-1]
    assert (first.session, first.has_clock, first.capture_utime) == (1, False, first.utime)
    assert (last.session, last.has_clock) == (1, True)


def test_a_skipped_frame_has_a_stamp_of_its_own(lab: Lab) -> None:
    lab.receive(*(frame(number, event=True) for number in range(600, 603)), late_us=200_000)
    captured = [stamp.capture_utime - BOOT_UTIME for stamp in lab.stamps]
    assert captured == pytest.approx([600 * PERIOD_US, 601 * PERIOD_US, 602 * PERIOD_US], abs=500)


def test_unknown_components_are_counted_and_the_others_published(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    known = encode_component(MARKERS, 600, 600 * PERIOD_US, np.zeros(1, ITEM_DTYPES[MARKERS]))
    unknown = bytes.fromhex("0000000c 00000063 00000000")  # size, type 99, four bytes
    body = encode_frame([known])
    count = (2).to_bytes(4, "big")
    for _ in range(3):
        lab.receive(split_frame(count + body[4:] + unknown, "big"))
    assert len(lab.published) == 3
    assert amounts(lab.status.losses.report()) == {"unknown component": (3, 3)}
    [limitation] = lab.status.limitations
    assert names(limitation, "[99]")
    assert caplog.messages == [f"lab (3d event): {limitation}"]


def test_bytes_after_the_last_component_are_a_limitation_once() -> None:
    lab = Lab("all")
    extended = split_frame(frame(1).body + b"\n", "big")
    for each in (extended, frame(2), extended):
        lab.ingest.receive([each], BOOT_UTIME, 0)
    assert len(lab.published) == 3
    [limitation] = lab.status.limitations
    assert names(limitation, "bytes")
