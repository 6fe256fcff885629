import time

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.measurement import LEAD_US, MAX_LEAD_US, Measurement
from tests.unit.rtc3d_server.counting_scene import CountingScene

MARKERS = (ComponentType.MARKERS,)


def measurement_of(scene: CountingScene, *, once: bool = False) -> Measurement:
    return Measurement(scene, event_bytes=24, once=once)


def test_time_passes_only_while_a_measurement_runs() -> None:
    measurement = measurement_of(CountingScene())
    before = measurement.elapsed_us()
    measurement.start()
    during = measurement.elapsed_us()
    measurement.stop()

    assert (before, measurement.elapsed_us()) == (None, None)
    assert during is not None
    assert during >= 0


def test_time_ends_with_the_only_pass_of_a_scene() -> None:
    measurement = measurement_of(CountingScene(rate_hz=1_000_000.0, num_frames=1), once=True)
    measurement.start()

    assert measurement.last_us == 0
    assert measurement.elapsed_us() in range(-LEAD_US, 1)


def test_a_scene_that_is_not_played_once_does_not_end() -> None:
    measurement = measurement_of(CountingScene(num_frames=1))
    measurement.start()

    assert measurement.last_us is None


def test_clients_with_the_same_components_share_its_frames_until_the_scene_changes() -> None:
    measurement = measurement_of(CountingScene())
    frames = measurement.frames(MARKERS)

    assert measurement.frames(MARKERS) is frames
    assert measurement.frames(()) is not frames
    measurement.change_scene(CountingScene(rate_hz=50.0))
    assert measurement.frames(MARKERS).rate == 50


def test_a_measurement_that_plays_once_begins_a_second_after_the_last_request() -> None:
    measurement = measurement_of(CountingScene(num_frames=100), once=True)
    measurement.start()
    time.sleep(0.01)
    measurement.postpone()

    elapsed_us = measurement.elapsed_us()
    assert elapsed_us is not None
    assert elapsed_us < 0.005e6 - LEAD_US


def test_requests_cannot_postpone_a_measurement_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    measurement = measurement_of(CountingScene(num_frames=1000), once=True)
    now_us = 0
    monkeypatch.setattr("gateway.rtc3d_server.measurement._now_us", lambda: now_us)
    measurement.start()
    for _ in range(10):
        now_us += LEAD_US // 2
        measurement.postpone()

    assert measurement.elapsed_us() == 10 * (LEAD_US // 2) - MAX_LEAD_US
