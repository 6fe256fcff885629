"""Rates that differ from the requested or announced ones are reported once; nothing else is."""

import logging
from collections.abc import Iterable, Mapping

import pytest

from gateway.config.settings import StreamSettings
from gateway.rtc3d.client_protocol import ProtocolState
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import ComponentType
from gateway.session.rate_check import Arrivals, RateWatch
from gateway.session.state import StreamState
from gateway.session.status import StreamStatus
from tests.support.errors import names
from tests.support.records import levels

MARKERS, TOOLS, ANALOG, EVENT = (
    ComponentType.MARKERS,
    ComponentType.TOOLS,
    ComponentType.ANALOG,
    ComponentType.EVENT,
)
ANNOUNCED = {MARKERS: 200.0, TOOLS: 200.0}
SLOW = (
    "frames arrive at 100 Hz instead of the announced 200 Hz; check the server's real-time processing rate "
    "and its load"
)


class Lab:
    """A watched stream, whose server sends frames as the test says."""

    def __init__(
        self,
        *components: ComponentType,
        rate: Rate | None = None,
        has_clock: bool = True,
        is_full_rate: bool = True,
        reports_sharing: bool = True,
        announced: Mapping[ComponentType, float] = ANNOUNCED,
    ) -> None:
        self.stream = StreamSettings(components=components or (MARKERS, TOOLS), rate=rate or AllFrames())
        self.status = StreamStatus("3d 6d", name="lab (3d 6d)")
        self.watch = RateWatch(self.status)
        self.announced = dict(announced)
        self.is_full_rate = is_full_rate
        self.reports_sharing = reports_sharing
        self.has_clock = has_clock
        self.now_s = 1000.0
        self.timestamp_us = 0.0
        self.num_restarts = 0
        self.num_frames = self.num_followed = 0
        self.connect()

    def connect(self) -> None:
        self.status.connecting("lab")
        self.status.connected("lab")
        self.status.handshake_done(ProtocolState.STREAMING, "lab", "AllFrames")
        assert self.status.state is StreamState.STREAMING
        self.status.clock.has_clock = self.has_clock

    def second(self, frames: int, *, advance_s: float = 1.0, followed: int | None = None) -> None:
        """Let a second pass in which frames arrive whose time stamps advance by ``advance_s``."""
        self.now_s += 1
        self.timestamp_us += 1e6 * advance_s
        self.num_frames += frames
        self.num_followed += frames if followed is None else followed
        self.check()

    def check(self, followed: ComponentType | None = None) -> None:
        arrivals = Arrivals(
            self.num_frames,
            followed or self.stream.components[0],
            self.num_followed,
            int(self.timestamp_us),
            frozenset(self.stream.components),
            self.num_restarts,
        )
        self.watch.check(
            self.stream,
            self.announced,
            arrivals,
            self.now_s,
            is_full_rate=self.is_full_rate,
            reports_sharing=self.reports_sharing,
        )

    def seconds(self, counts: Iterable[int]) -> list[str]:
        for count in counts:
            self.second(count)
        return self.status.limitations


def test_frames_that_are_too_slow_are_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab()
    assert lab.seconds([100] * 60) == [SLOW]
    assert [record.message for record in caplog.records if record.levelno == logging.WARNING] == [
        f"lab (3d 6d): {SLOW}"
    ]


def test_other_components_on_an_open_connection_are_measured_anew() -> None:
    """With streams: auto, they get another session; what was found about the former ones is void."""
    lab = Lab()
    assert lab.seconds([100] * 60) == [SLOW]
    lab.status.session += 1
    lab.second(100)
    assert lab.status.limitations == []
    assert lab.seconds([100] * 60) == [SLOW]


def test_a_measurement_waits_for_enough_frames_of_the_followed_component() -> None:
    """Its time stamps are the measure: 20 of them are there after 20 s."""
    lab = Lab()
    for _ in range(60):
        lab.second(100, followed=1)
    assert lab.status.limitations == []
    lab.second(100, followed=1)
    assert lab.status.limitations == [SLOW]


def test_a_component_that_shares_a_stream_is_not_reported_twice() -> None:
    """The plan of ``streams: auto`` says it already."""
    lab = Lab(MARKERS, ANALOG, announced=ANNOUNCED | {ANALOG: 2000.0}, reports_sharing=False)
    assert lab.seconds([200] * 60) == []


HZ_60 = Frequency(60.0)


@pytest.mark.parametrize(
    ("lab", "arriving", "expected"),
    [
        (Lab(), 400, ["400 Hz", "announced 200 Hz"]),
        (Lab(rate=HZ_60), 200, ["200 Hz", "requested 60 Hz"]),
        (Lab(rate=FrequencyDivisor(4)), 200, ["200 Hz", "requested 50 Hz"]),
        (Lab(rate=HZ_60), 30, ["30 Hz", "requested 60 Hz"]),
        (Lab(rate=HZ_60, announced={}), 100, ["100 Hz", "requested 60 Hz"]),
        (
            Lab(MARKERS, ANALOG, announced=ANNOUNCED | {ANALOG: 2000.0}),
            200,
            ["analog", "200 Hz", "2000 Hz", "streams: auto"],
        ),
    ],
)
def test_another_rate_than_the_requested_or_the_announced_one_is_reported(
    lab: Lab, arriving: int, expected: list[str]
) -> None:
    [limitation] = lab.seconds([arriving] * 60)
    assert names(limitation, *expected)


@pytest.mark.parametrize(
    ("lab", "arriving", "followed"),
    [
        pytest.param(Lab(rate=Frequency(1000.0)), 200, 200, id="the announced rate is the limit"),
        pytest.param(Lab(is_full_rate=False), 100, 100, id="the gateway has requested less"),
        pytest.param(Lab(), 200, 100, id="a component is left out at times"),
        pytest.param(
            Lab(MARKERS, ANALOG, announced=ANNOUNCED | {ANALOG: 2000.0}),
            2200,
            200,
            id="in frames of their own",
        ),
        pytest.param(Lab(EVENT, rate=HZ_60), 500, 500, id="events have no rate"),
        pytest.param(Lab(announced={}), 3, 3, id="no rate to compare"),
    ],
)
def test_what_may_have_another_reason_is_not_reported(lab: Lab, arriving: int, followed: int) -> None:
    for _ in range(100):
        lab.second(arriving, followed=followed)
    assert lab.status.limitations == []


def test_a_slow_stream_is_measured_for_longer() -> None:
    lab = Lab(announced={MARKERS: 2.0, TOOLS: 2.0})
    assert lab.seconds([2] * 100) == []
    [limitation] = lab.seconds([1] * 100)
    assert names(limitation, "1 Hz", "announced 2 Hz")


def test_the_end_of_a_difference_is_logged_and_shown(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    lab = Lab()
    assert lab.seconds([100] * 20) == [SLOW]
    assert lab.seconds([200] * 20) == []
    assert levels(caplog, logging.INFO)[-2:] == ["WARNING", "INFO"]


def test_a_difference_is_shown_for_the_next_connection_again_without_another_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = Lab()
    lab.seconds([100] * 20)
    lab.connect()
    assert lab.status.limitations == []
    assert lab.seconds([100] * 20) == [SLOW]
    assert len([record for record in caplog.records if record.levelno == logging.WARNING]) == 1


@pytest.mark.parametrize(
    "counts", [[195, 205] * 30, [185] * 60, [215] * 60, [0, 0, 600] * 20, [200, 0, 400] * 20]
)
def test_irregular_arrival_is_not_reported(counts: list[int]) -> None:
    lab = Lab()
    for count in counts:
        lab.second(count, advance_s=count / 200 if count in (0, 400, 600) else 1.0)
    assert lab.status.limitations == []


@pytest.mark.parametrize("speed", [2, 4])
@pytest.mark.parametrize("stopped_s", [5, 30])
def test_a_stop_of_the_process_and_its_backlog_are_not_reported(stopped_s: int, speed: int) -> None:
    lab = Lab()
    lab.seconds([200] * 20)
    lab.now_s += stopped_s
    for _ in range(stopped_s // (speed - 1)):
        lab.second(200 * speed, advance_s=speed)
    assert lab.seconds([200] * 20) == []


def test_a_backlog_without_a_clock_is_not_reported() -> None:
    lab = Lab(has_clock=False)
    lab.seconds([200] * 20)
    lab.now_s += 10
    assert lab.seconds([400] * 10 + [200] * 60) == []


def test_time_stamps_that_are_no_clock_are_ignored() -> None:
    lab = Lab(has_clock=False)
    for _ in range(60):
        lab.second(200, advance_s=0.001)
    assert lab.status.limitations == []
    for _ in range(60):
        lab.second(100, advance_s=0.0)
    assert lab.status.limitations == [SLOW]


def test_restarts_of_the_server_are_not_reported() -> None:
    lab = Lab()
    for _ in range(20):
        lab.seconds([200] * 4)
        lab.timestamp_us = 0.0
        lab.num_restarts += 1
    assert lab.status.limitations == []


def test_changed_parameters_begin_a_new_measurement() -> None:
    lab = Lab()
    assert lab.seconds([100] * 20) == [SLOW]
    lab.announced = {MARKERS: 100.0, TOOLS: 100.0}
    assert lab.seconds([100] * 20) == []
