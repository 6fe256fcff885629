"""The clock of a measurement, the frames that clients share, and timers that are never early."""

import asyncio
from collections.abc import Callable

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.measurement import LEAD_US, MAX_LEAD_US, Measurement
from gateway.rtc3d_server.timers import call_after_us
from tests.unit.rtc3d_server.counting_scene import CountingScene

MARKERS = (ComponentType.MARKERS,)


class Clock:
    now_us = 5_000_000


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("gateway.rtc3d_server.measurement._now_us", lambda: clock.now_us)
    return clock


class LoggingScene(CountingScene):
    """A scene that notes when it is started and stopped, and needs to be advanced every 100 ms."""

    def __init__(self) -> None:
        super().__init__(num_frames=100)
        self.calls: list[str] = []

    def start(self) -> None:
        self.calls.append("start")

    def advance(self, elapsed_us: int) -> int:
        self.calls.append(f"advance {elapsed_us}")
        return elapsed_us + 100_000

    def stop(self) -> None:
        self.calls.append("stop")


def measurement_of(scene: CountingScene, *, once: bool = False) -> Measurement:
    return Measurement(scene, event_bytes=24, once=once)


def test_time_passes_only_while_a_measurement_runs(clock: Clock) -> None:
    """Time stamps count from the start of each measurement."""
    measurement = measurement_of(CountingScene(num_frames=1))
    assert (measurement.elapsed_us(), measurement.is_running) == (None, False)
    for _ in range(2):
        measurement.start()
        assert (measurement.elapsed_us(), measurement.last_us) == (0, None)
        clock.now_us += 60_000_000  # far beyond the only frame: the scene repeats
        assert measurement.elapsed_us() == 60_000_000
        measurement.stop()
        measurement.stop()
        assert (measurement.elapsed_us(), measurement.is_running) == (None, False)


def test_the_only_pass_of_a_scene_ends_before_the_first_frame_of_the_next(clock: Clock) -> None:
    """At the time of the end itself, a frame of the next pass would be due."""
    measurement = measurement_of(CountingScene(num_frames=100), once=True)
    measurement.start()
    assert measurement.elapsed_us() == -LEAD_US
    clock.now_us += LEAD_US + 5_000_000
    assert measurement.elapsed_us() == measurement.last_us == 999_999


def test_a_measurement_that_plays_once_begins_a_second_after_the_last_request(clock: Clock) -> None:
    """A gateway requests frames on several connections, and gets the first ones on all of them."""
    measurement = measurement_of(CountingScene(num_frames=1000), once=True)
    measurement.start()
    clock.now_us += LEAD_US // 2
    measurement.postpone()
    assert measurement.elapsed_us() == -LEAD_US
    for _ in range(9):
        clock.now_us += LEAD_US // 2
        measurement.postpone()  # which requests cannot do for ever
    assert measurement.elapsed_us() == 10 * (LEAD_US // 2) - MAX_LEAD_US


def test_a_request_during_a_measurement_does_not_postpone_it(clock: Clock) -> None:
    """Time stamps would jump back for all who stream already."""
    measurement = measurement_of(CountingScene(num_frames=1000), once=True)
    measurement.start()
    clock.now_us += LEAD_US + 500_000
    measurement.postpone()
    assert measurement.elapsed_us() == 500_000


def test_the_scene_of_the_start_is_played_even_while_another_one_is_shown(clock: Clock) -> None:
    """A fault changes what clients see; the recording goes on behind it."""
    scene = LoggingScene()
    measurement = measurement_of(scene)
    measurement.start()
    measurement.change_scene(CountingScene(rate_hz=50.0))
    clock.now_us += 250_000
    measurement.advance()
    advance_us = [measurement.advance_us]
    measurement.stop()
    measurement.advance()
    assert [*advance_us, measurement.advance_us] == [350_000, None]
    assert scene.calls == ["start", "advance 0", "advance 250000", "stop"]
    other = LoggingScene()
    measurement.change_scene(other)
    measurement.start()  # plays the scene that is shown now
    assert other.calls == ["start", "advance 0"]


@pytest.mark.usefixtures("clock")
def test_clients_share_frames_until_the_scene_or_the_measurement_changes() -> None:
    """Sharing saves building them; frames of an earlier measurement have its old contents."""
    measurement = measurement_of(CountingScene())
    frames = measurement.frames(MARKERS)
    assert measurement.frames(MARKERS) is frames
    assert measurement.frames(()) is not frames
    measurement.start()
    assert measurement.frames(MARKERS) is not frames
    measurement.change_scene(CountingScene(rate_hz=50.0))
    assert measurement.frames(MARKERS).rate == 50


@pytest.mark.parametrize(
    ("delay_us", "delay_s"), [(-1500, 0), (0, 0), (0.5, 0.001), (1000, 0.001), (1001, 0.002), (29_000, 0.029)]
)
def test_a_delay_is_rounded_up_to_whole_milliseconds(
    delay_us: float, delay_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """uvloop counts whole milliseconds: a timer that is early finds nothing due, many times over."""
    called: list[float] = []

    class Loop:
        def call_later(self, delay_s: float, callback: Callable[[], object]) -> None:  # noqa: ARG002 - not called
            called.append(delay_s)

    monkeypatch.setattr(asyncio, "get_running_loop", Loop)
    call_after_us(delay_us, lambda: None)
    assert called == [delay_s]
