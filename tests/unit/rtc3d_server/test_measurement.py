from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.measurement import Measurement
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
    assert measurement.elapsed_us() == 0


def test_a_scene_that_is_not_played_once_does_not_end() -> None:
    measurement = measurement_of(CountingScene(num_frames=1))
    measurement.start()

    assert measurement.last_us is None


def test_clients_with_the_same_components_share_a_frame_builder_until_the_scene_changes() -> None:
    measurement = measurement_of(CountingScene())
    builder = measurement.frame_builder(MARKERS)

    assert measurement.frame_builder(MARKERS) is builder
    assert measurement.frame_builder(()) is not builder
    measurement.change_scene(CountingScene(rate_hz=50.0))
    assert measurement.frame_builder(MARKERS).rate == 50
