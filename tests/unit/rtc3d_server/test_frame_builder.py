"""Frames of computed scenes: their bytes, rates, numbers and events."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d_server.frame_builder import FrameBuilder, exact_rate
from tests.unit.rtc3d_server.counting_scene import CountingScene
from tests.unit.rtc3d_server.wire import (
    ANALOG,
    DATA,
    EVENT,
    MARKERS,
    TOOLS,
    WireComponent,
    components_in,
    packets_in,
)


def built_components(builder: FrameBuilder, tick: int, *, with_events: bool = False) -> list[WireComponent]:
    [(packet_type, body)] = packets_in(builder.packet("big", tick, 0 if with_events else None).packet)
    assert packet_type == DATA
    return components_in(body)


def test_a_frame_has_the_bytes_of_the_specification() -> None:
    builder = FrameBuilder(CountingScene(), (ComponentType.MARKERS,))
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
def test_a_frame_has_the_requested_components_of_the_scene_in_wire_order(
    requested: tuple[ComponentType, ...], built: list[int]
) -> None:
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
    builder = FrameBuilder(CountingScene(), (ComponentType.MARKERS,))
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
    builder = FrameBuilder(CountingScene(rate_hz), (ComponentType.MARKERS,))
    tick = builder.tick_after(elapsed_us)
    assert builder.time_us(tick - 1) <= elapsed_us < builder.time_us(tick)
