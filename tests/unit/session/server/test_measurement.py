"""Measurements of computed scenes: their clock, the bytes, rates and numbers of their frames, and timers."""

import asyncio
from collections.abc import Callable
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.rtc3d.components import ComponentType
from gateway.session.server.measurement import (
    LEAD_US,
    MAX_LEAD_US,
    FrameBuilder,
    Measurement,
    call_after_us,
    exact_rate,
)
from tests.unit.session.server.counting_scene import CountingScene
from tests.unit.session.server.wire import (
    ANALOG,
    DATA,
    EVENT,
    MARKERS,
    TOOLS,
    WireComponent,
    components_in,
    packets_in,
)

ONLY_MARKERS = (ComponentType.MARKERS,)


class Clock:
    now_us = 5_000_000


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("gateway.session.server.measurement._now_us", lambda: clock.now_us)
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
    frames = measurement.frames(ONLY_MARKERS)
    assert measurement.frames(ONLY_MARKERS) is frames
    assert measurement.frames(()) is not frames
    measurement.start()
    assert measurement.frames(ONLY_MARKERS) is not frames
    measurement.change_scene(CountingScene(rate_hz=50.0))
    assert measurement.frames(ONLY_MARKERS).rate == 50


@pytest.mark.parametrize(
    ("delay_us", "delay_s"), [(-1500, 0), (0, 0), (0.5, 0.001), (1000, 0.001), (1001, 0.002), (29_000, 0.029)]
)
def test_a_delay_is_rounded_up(delay_us: float, delay_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """uvloop counts whole milliseconds: a timer that is early finds nothing due, many times over."""
    called: list[float] = []

    class Loop:
        def call_later(self, delay_s: float, callback: Callable[[], object]) -> None:  # noqa: ARG002 - not called
            called.append(delay_s)

    monkeypatch.setattr(asyncio, "get_running_loop", Loop)
    call_after_us(delay_us, lambda: None)
    assert called == [delay_s]


# Frames ----------------------------------------------------------------------------------------


def built_components(builder: FrameBuilder, tick: int, *, with_events: bool = False) -> list[WireComponent]:
    [(packet_type, body)] = packets_in(builder.packet("big", tick, 0 if with_events else None).packet)
    assert packet_type == DATA
    return components_in(body)


def test_a_frame_has_the_bytes_of_the_specification() -> None:
    builder = FrameBuilder(CountingScene(), ONLY_MARKERS)
    assert builder.packet("big", 3).packet == bytes.fromhex(
        "00000044 00000003"  # size 68, data frame
        "00000001"  # one component
        "00000038 00000001 00000004 0000000000007530"  # 56 bytes, 3D, frame 4, 30000 µs
        "00000002"  # two markers
        "40400000 00000000 00000000 00000000"  # 3, 0, 0; 0
        "40400000 3FC00000 C0000000 3E800000"  # 3, 1.5, -2; 0.25
    )
    assert builder.packet("little", 3).packet == bytes.fromhex(
        "00000044 00000003"  # the packet's header stays big-endian
        "01000000"
        "38000000 01000000 04000000 3075000000000000"
        "02000000"
        "00004040 00000000 00000000 00000000"
        "00004040 0000C03F 000000C0 0000803E"
    )


@pytest.mark.parametrize(
    ("requested", "built"),
    [
        ((), [MARKERS, TOOLS, ANALOG, EVENT]),
        ((ComponentType.FORCE, ComponentType.ANALOG), [ANALOG]),  # the scene lacks force plates
        ((ComponentType.MARKERS,), [MARKERS]),
    ],
)
def test_a_frame_has_components_in_wire_order(requested: tuple[ComponentType, ...], built: list[int]) -> None:
    components = built_components(FrameBuilder(CountingScene(), requested), 100, with_events=True)
    assert [component.type for component in components] == built


def test_the_rate_is_that_of_the_slowest_component_and_each_has_its_own_sample() -> None:
    builder = FrameBuilder(CountingScene(rate_hz=200), (ComponentType.MARKERS, ComponentType.ANALOG))
    markers, analog = built_components(builder, 20)
    assert builder.rate == 200
    assert (markers.frame_number, analog.frame_number) == (21, 201)
    assert markers.timestamp_us == analog.timestamp_us == 100_000
    assert (markers.items[0][0], analog.items[0][0]) == (20, 200)


def test_samples_are_consecutive_across_blocks_of_frames() -> None:
    builder = FrameBuilder(CountingScene(), (ComponentType.ANALOG,))
    samples = [built_components(builder, tick)[0].items[0][0] for tick in range(300)]
    assert samples == list(range(300))


def test_events_are_numbered_at_the_measurement_rate_alone_and_in_frames_of_any_rate() -> None:
    """An event's number tells to which frame of the measurement it belongs, not to which of the stream."""
    builder = FrameBuilder(CountingScene(), (ComponentType.EVENT,))
    events = WireComponent(EVENT, 15, 140_000, [(1, 70_000, -1, -1, -1), (2, 140_000, -1, -1, -1)])
    assert built_components(builder, 14, with_events=True) == [events]
    assert built_components(builder, 14) == []
    builder = FrameBuilder(CountingScene(), (ComponentType.ANALOG, ComponentType.EVENT))
    analog, event = built_components(builder, 75, with_events=True)
    assert (analog.frame_number, event.frame_number) == (76, 8)


def test_events_can_have_the_16_bytes_of_the_specification() -> None:
    builder = FrameBuilder(CountingScene(), (ComponentType.EVENT,), event_bytes=16)
    data = builder.packet("little", 7, 0)
    assert components_in(data.packet[8:], "little", event_bytes=16) == [
        WireComponent(EVENT, 8, 70_000, [(1, -1, -1, -1)])
    ]


def test_frame_numbers_stay_within_a_signed_32_bit_field() -> None:
    builder = FrameBuilder(CountingScene(), ONLY_MARKERS)
    assert built_components(builder, 2**31 - 2)[0].frame_number == 2**31 - 1
    assert built_components(builder, 2**31 - 1)[0].frame_number == 0


@pytest.mark.parametrize(
    ("rate_hz", "exact"),
    [
        *((100.0, Fraction(100)), (59.94006, Fraction(60000, 1001))),
        *((29.97, Fraction(2997, 100)), (0.5, Fraction(1, 2))),
    ],
)
def test_a_rounded_rate_becomes_an_exact_fraction(rate_hz: float, exact: Fraction) -> None:
    assert exact_rate(rate_hz) == exact


@given(rate_hz=st.integers(1, 5000).map(float) | st.floats(1, 5000), elapsed_us=st.integers(0, 10**13))
def test_the_tick_after_a_time_is_the_first_one_later(rate_hz: float, elapsed_us: int) -> None:
    builder = FrameBuilder(CountingScene(rate_hz), ONLY_MARKERS)
    tick = builder.tick_after(elapsed_us)
    assert builder.time_us(tick - 1) <= elapsed_us < builder.time_us(tick)
