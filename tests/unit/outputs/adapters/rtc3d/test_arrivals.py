"""What is kept of a live source, the rates of its streams, and the limits of both."""

import struct
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any

import pytest

from gateway.outputs.adapters.rtc3d.arrivals import (
    ArrivedFrame,
    Kept,
    NewestFrames,
    StreamRate,
    encode_joined,
)
from gateway.outputs.adapters.rtc3d.live_frames import KEPT_EVENTS, LiveFrames
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from gateway.rtc3d.frames import split_frame
from tests.unit.outputs.adapters.rtc3d.scripted_server import (
    FAST,
    SLOW,
    TOOL_OUT_OF_VIEW,
    analog,
    body,
    component,
    event,
    markers,
)
from tests.unit.session.server.wire import EVENT, components_in

MARKERS, ANALOG = ComponentType.MARKERS, ComponentType.ANALOG
BOTH = (MARKERS, ANALOG)
Kinds = Sequence[ComponentType]


class Source:
    """Frames that arrive at chosen times, and the frames of a client's choice of components."""

    def __init__(
        self, requested: Kinds = BOTH, *, is_new: bool = False, played: int = 0, **announced_hz: Any
    ) -> None:
        self.arrivals = NewestFrames()
        if not is_new:
            self.arrivals.began_us = -1_000_000_000  # frames do not wait until rates are known
        rates_hz = {ComponentType[name]: rate_hz for name, rate_hz in announced_hz.items()}
        self.frames = LiveFrames(requested, self.arrivals, rates_hz)
        self.play(played)

    def add(self, at_us: int, *components: bytes, stream: int = SLOW) -> ArrivedFrame:
        arrival = self.arrivals.add(
            split_frame(body(*components), "big"), stream, frozenset(WIRE_ORDER), at_us
        )
        assert arrival is not None
        return arrival

    def arrive(self, at_us: int, *components: bytes, stream: int = SLOW) -> int | None:
        self.add(at_us, *components, stream=stream)
        return self.frames.update(at_us)

    def play(self, count: int, period_us: int = 10_000) -> None:
        """Let pairs of markers and analog channels arrive on two streams whose rates are known."""
        if not count:
            return
        for kind, stream in ((MARKERS, SLOW), (ANALOG, FAST)):
            self.arrivals.stream_of[kind] = stream
            self.arrivals.rates[stream] = rate = StreamRate()
            rate._intervals_us.extend((period_us, period_us))
        for number in range(1, count + 1):
            self.arrive(number * period_us, analog(number, number * period_us), stream=FAST)
            self.arrive(number * period_us + 1, markers(number, number * period_us))

    def packets(self) -> list[Any]:
        frames = self.frames
        return [frames.packet("big", tick) for tick in range(frames.tick_after(-1), frames.next_frame)]

    def numbers(self) -> list[list[int]]:
        return [[each.frame_number for each in components_in(packet.packet[8:])] for packet in self.packets()]

    def arrive_regularly(self, numbers: Iterable[int], *, with_events: bool = False) -> None:
        """Let markers arrive, whose number is also their time stamp."""
        for number in numbers:
            events = [event(number, number, number)] if with_events else []
            self.arrive(number * 10, markers(number, number), *events)

    def forget(self) -> None:
        self.arrivals.frames.clear()
        self.frames.forget()


# What is kept -------------------------------------------------------------------------------


def test_the_newest_items_are_kept_up_to_a_number_and_a_size() -> None:
    """The memory for clients that do not read is bounded, and numbers stay those of the items."""
    kept: Kept[bytes] = Kept(3, 10, len)
    assert [kept.append(item) for item in (b"a", b"b", b"c", b"d")] == [None, None, None, b"a"]
    assert (kept.first, kept.end, kept[1], list(kept.since(0))) == (1, 4, b"b", [b"b", b"c", b"d"])
    assert list(kept.since(3)) == [b"d"]
    assert kept.append(b"e" * 8) == b"b"  # 3 items and 10 bytes are not too many
    assert kept.append(b"f" * 11) == b"e" * 8  # at least one item is kept, however large
    assert (list(kept.since(0)), kept.first) == ([b"f" * 11], 5)
    assert kept.append(b"g" * 10) == b"f" * 11
    kept.clear()
    assert (len(kept), kept.first, kept.end) == (0, 7, 7)
    assert [kept.append(item) for item in (b"h" * 9, b"i")] == [None, None]


def test_the_rate_is_the_median_of_the_newest_time_stamps_or_that_of_the_arrivals() -> None:
    """Two intervals are needed, because the first frame can come late."""
    source, rate = Source(), StreamRate()
    for number, period_us in ((1, None), (2, None), (3, 10_000)):
        rate.add(source.add(10_500 * number, markers(number, 10_000 * number)))
        assert (rate.period_us, rate.has_times) == (period_us, True)
    for number in range(4, 40):
        rate.add(source.add(10_500 * number, markers(number, 10_000 + 5_000 * number)))
    assert rate.period_us == 5_000
    without_times = StreamRate()  # some servers send zeros
    for number in (1, 2, 3):
        without_times.add(source.add(10**9 + 7_000 * number, markers(number, 0)))
    assert (without_times.period_us, without_times.has_times) == (7_000, False)


@pytest.mark.parametrize("pause", ["restart", "skip"])
def test_the_interval_across_a_pause_does_not_count(pause: str) -> None:
    """A pause says nothing about the rate, nor does the first time stamp of a new measurement."""
    source, rate = Source(), StreamRate()
    rate.add(source.add(10_000, markers(1, 10_000)))
    rate.add(source.add(20_000, markers(2, 20_000)))
    rate.restart() if pause == "restart" else rate.skip(500_000)
    assert rate.time_us == (0 if pause == "restart" else 520_000)
    rate.add(source.add(530_000, markers(1, 5_000)))
    assert (rate.has_times, rate.period_us) == (True, None)
    rate.add(source.add(540_000, markers(2, 15_000)))
    assert rate.period_us == 10_000


def test_arrival_times_grow_and_begin_again_with_a_measurement() -> None:
    """Clients are served by these times, so two frames of one moment must differ."""
    source = Source(is_new=True)
    assert [source.add(at_us, markers(1, at_us)).time_us for at_us in (50, 50, 20, 90)] == [50, 51, 52, 90]
    assert source.arrivals.began_us == 50
    source.arrivals.restart()
    assert source.add(7, markers(1, 7)).time_us == 7
    assert source.arrivals.began_us < -1_000_000  # what is known of the streams stays known


def test_a_pause_without_frames_is_left_out_of_the_age_of_streams() -> None:
    """A stream is not dead because nobody asked for frames."""
    source = Source()
    source.add(100, markers(1, 100))
    source.add(200, analog(1, 100), stream=FAST)
    source.arrivals.frames.clear()
    source.add(5_000_200, markers(2, 5_000_000))
    assert source.arrivals.rates[FAST].time_us == 5_000_200
    source.arrivals.restart()
    source.add(300, markers(3, 300))
    assert source.arrivals.rates[FAST].time_us == 300


def test_a_new_connection_takes_over_the_rate_and_the_old_one_is_forgotten() -> None:
    """A source that reconnects for days must not leave traces."""
    source = Source(played=3)
    source.add(40_000, markers(4, 40_000), stream=7)
    assert source.arrivals.rates[7].period_us == 10_000
    assert set(source.arrivals.rates) == {7, FAST}
    assert source.arrivals.stream_of == {MARKERS: 7, ANALOG: FAST}
    for stream in range(8, 20):
        source.arrive(stream * 10_000, analog(stream, 10_000 * stream), stream=stream)
    assert len(source.frames._join._samples) <= 2


def test_a_component_that_moves_to_another_stream_does_not_change_the_rate_of_that() -> None:
    """With streams: auto, the first stream takes over what a further one had, at its own rate."""
    source, played = Source(), 20
    for number in range(1, played + 1):
        source.add(10_000 * number, markers(number, 10_000 * number))
    for number in range(played, played + 10):
        time_us = 10_000 * played + 1000 * number
        both = number >= played + 5
        source.add(
            time_us, *([markers(number, time_us)] if both else []), analog(number, time_us), stream=FAST
        )
    assert source.arrivals.stream_of == {MARKERS: FAST, ANALOG: FAST}
    assert source.arrivals.rates[FAST].period_us == 1000


# Which frame is meant -----------------------------------------------------------------------


def test_frames_are_found_by_time_after_older_ones_were_forgotten() -> None:
    """Clients keep the numbers of frames over a pause."""
    source = Source([MARKERS])
    source.arrive_regularly([1, 2])
    source.forget()
    source.arrive_regularly([3, 4, 5])
    frames = source.frames
    assert [frames.tick_after(at_us) for at_us in (0, 29, 30, 39, 40, 49, 50, 60)] == [2, 2, 3, 3, 4, 4, 5, 5]
    assert [frames.time_us(tick) for tick in (1, 2, 4)] == [-1, 30, 50]
    assert frames.time_us(5) > 10**15
    assert frames.oldest_us(99) == 29
    source.forget()
    assert frames.oldest_us(99) == 99


def test_the_announced_rate_of_the_slowest_component_counts_until_it_is_measured() -> None:
    """Joined frames have the rate of the slowest component."""
    announced: dict[str, Any] = {"MARKERS": 200.0, "TOOLS": 50.0, "ANALOG": 1000.0}
    assert Source([], **announced).frames.rate == 50
    assert Source(BOTH, **announced).frames.rate == 200
    assert Source().frames.rate == Fraction(100)
    source = Source([], **announced)
    source.arrive(1, markers(1, 10), TOOL_OUT_OF_VIEW)
    assert source.frames.rate == 50
    for number in range(2, 9):
        source.arrive(number * 4000, markers(number, number * 4000))
    assert source.frames.rate == 250


def test_the_packets_that_clients_share_are_bounded() -> None:
    """Clients with different choices of events would fill the memory."""
    source = Source([MARKERS])
    source.arrive_regularly(range(1, 201))
    assert source.numbers()[-1] == [200]
    assert len(source.frames._packets) == 64
    source.forget()
    assert not source.frames._packets


# Events -------------------------------------------------------------------------------------


def events_in(packet: Any) -> list[int]:
    events = [each for each in components_in(packet.packet[8:]) if each.type == EVENT]
    return [int(item[0]) for each in events for item in each.items]


def test_a_frame_has_the_events_from_a_time_up_to_its_own() -> None:
    """No event is sent twice, and none is left out."""
    source = Source([MARKERS, ComponentType.EVENT])
    source.arrive_regularly(range(1, 5), with_events=True)
    found = [events_in(source.frames.packet("big", 2, from_us)) for from_us in (0, 10, 11, 20, 30, 31)]
    assert found == [[1, 2, 3], [1, 2, 3], [2, 3], [2, 3], [3], []]
    assert source.frames.packet("big", 2, 20).components == (MARKERS, ComponentType.EVENT)
    assert source.frames.packet("big", 2, 31).components == (MARKERS,)


def test_a_frame_lacks_events_only_if_one_of_its_own_was_dropped() -> None:
    """Clients are told of their losses exactly."""
    source = Source([MARKERS, ComponentType.EVENT])
    source.arrive_regularly(range(1, KEPT_EVENTS + 2), with_events=True)
    newest = source.frames.next_frame - 1
    assert source.frames.packet("big", newest, 10).lacks_events
    assert not source.frames.packet("big", newest, 11).lacks_events
    source.forget()
    source.arrive(10**6, markers(1, 1), event(1, 1, 77))
    packet = source.frames.packet("big", newest + 1, 0)
    assert (events_in(packet), packet.lacks_events) == ([77], False)


def test_events_of_several_frames_become_one_component_of_each_size() -> None:
    """Servers write events with 24 or 16 bytes; one component has one size, and the frame's time stamp."""
    source = Source([MARKERS, ComponentType.EVENT])
    short = struct.pack(">IIiqI", 40, EVENT, 1, 10, 1) + struct.pack(">4i", 9, 10, -1, -1)
    for number, events in ((1, event(1, 10, 1)), (2, short), (3, event(3, 30, 3))):
        source.arrive(10 * number, markers(number, 10 * number), events)
    [packet] = [source.frames.packet("big", 2, 0)]
    expected = body(
        markers(3, 30),
        component(EVENT, 3, 30, [(1, 10, -1, -1, -1), (3, 30, -1, -1, -1)]),
        struct.pack(">IIiqI", 40, EVENT, 3, 30, 1) + struct.pack(">4i", 9, 10, -1, -1),
    )
    assert packet.packet[8:] == expected


# Joining ------------------------------------------------------------------------------------


def test_a_joined_packet_has_and_names_the_components_of_all_its_streams() -> None:
    """Of a component in two frames the first counts: it sets the rate, and its time stamp is the frame's."""
    source = Source(played=3)
    assert source.packets()[-1].components == (MARKERS, ANALOG)
    assert source.numbers() == [[1, 1], [2, 2], [3, 3]]
    arrivals = [source.add(1, markers(1, 10)), source.add(2, markers(2, 20), analog(2, 20), stream=FAST)]
    assert encode_joined(arrivals, frozenset(BOTH), [], "big") == body(markers(1, 10), analog(2, 20))


@pytest.mark.parametrize(
    ("analog_us", "is_joined", "waits"),
    [(39_997, True, True), (39_998, True, False), (40_002, True, False), (40_003, False, False)],
)
def test_time_stamps_of_a_moment_differ_by_rounding(analog_us: int, is_joined: bool, waits: bool) -> None:
    """By 2 µs and not more: a later sample belongs to the next frame, an earlier one may not be the last."""
    source = Source(played=3)
    source.arrive(40_000, analog(4, analog_us), stream=FAST)
    due_us = source.arrive(40_001, markers(4, 40_000))
    assert due_us == (40_001 + 250_000 if waits else None)
    source.frames.update(40_001 + 250_000)
    assert source.numbers()[3:] == [[4, 4] if is_joined else [4]]


def test_a_frame_waits_exactly_a_quarter_of_a_second_for_its_samples() -> None:
    """A connection can stand still for a moment; after that the frame goes without."""
    source = Source(played=3)
    assert source.arrive(40_000, markers(4, 40_000)) == source.frames.update(289_999) == 290_000
    assert len(source.numbers()) == 3
    assert source.frames.update(290_000) is None
    assert source.numbers()[3:] == [[4]]


def test_a_stream_without_times_is_not_waited_for_and_gives_its_newest_sample() -> None:
    """Its time stamps say nothing: neither how far it is, nor where its samples belong."""
    for stuck_us in (0, 900_000):
        source = Source(played=3)
        for number in range(4, 8):
            source.arrive(number * 10_000, analog(number, stuck_us), stream=FAST)
            source.arrive(number * 10_000 + 1, markers(number, number * 10_000))
        assert source.numbers()[-3:] == [[5, 5], [6, 6], [7, 7]]


def test_of_two_streams_with_nearly_one_rate_the_first_sets_it() -> None:
    """Otherwise rounding would make the leading stream change from frame to frame."""
    source = Source()
    for number in range(1, 9):
        source.arrive(number * 10_000, markers(number, number * 10_000), stream=SLOW)
        source.arrive(number * 10_000 + 5_000, analog(number, number * 10_050 + 5_000), stream=FAST)
    assert source.numbers()[-2:] == [[7, 6], [8, 7]]


def test_a_stream_of_one_frame_in_a_second_goes_on_setting_the_rate() -> None:
    """It counts as long as three of its periods have not passed."""
    source = Source()
    for tenth in range(1, 119):
        at_us = tenth * 100_000
        source.arrive(at_us, analog(tenth, at_us), stream=FAST)
        if tenth % 20 == 0:
            source.arrive(at_us + 1, markers(tenth, at_us))
    assert source.numbers()[-2:] == [[80, 80], [100, 100]]


def test_frames_that_wait_are_bounded() -> None:
    """Frames can arrive faster than time passes."""
    source = Source()
    source.play(3, 900)
    for number in range(4, 4 + 1024 + 2):
        source.arrive(4_000 + number, markers(number, 900 * number))
    assert source.numbers()[3:] == [[4], [5]]


def test_frames_get_later_times_even_if_they_have_waited() -> None:
    """Clients look for frames by time, so a frame that comes later must not be earlier."""
    source = Source((*BOTH, ComponentType.EVENT), played=3)
    source.arrive(40_000, markers(4, 40_000))
    source.arrive(2_000_000, event(5, 50_000, 5))
    times_us = [source.frames.time_us(tick) for tick in range(source.frames.next_frame)]
    assert times_us == sorted(set(times_us))


@pytest.mark.parametrize(
    ("forgotten", "arrivals", "sent"),
    [
        pytest.param("", [(40_000, 4, 40_000), (40_001, -4, 5_000_000)], [[4, 4]], id="another clock"),
        pytest.param("", [(40_000, -4, 40_000), (41_000, 5, 50_000)], [[4]], id="a lost sample"),
        pytest.param("all", [(41_000, 9, 45_000), (41_001, -4, 40_000)], [], id="before the samples"),
        pytest.param("all", [(41_000, 9, 1_039_999), (41_001, -4, 40_000)], [], id="long before them"),
        pytest.param("all", [(41_000, 9, 1_040_000), (41_001, -4, 40_000)], [[4]], id="another clock again"),
        pytest.param("frames", [(280_000, -4, 280_000)], [[4]], id="a silent stream, which may stay silent"),
    ],
)
def test_whether_a_frame_goes_without_a_sample_or_is_left_out(
    forgotten: str, arrivals: list[tuple[int, int, int]], sent: list[list[int]]
) -> None:
    """The first frame after a pause is left out if it is from before the client asked.

    Positive numbers are those of analog frames, negative ones those of markers.
    """
    source = Source(played=3)
    {"": lambda: None, "all": source.forget, "frames": source.frames.forget}[forgotten]()
    for at_us, number, timestamp_us in arrivals:
        if number > 0:
            source.arrive(at_us, analog(number, timestamp_us), stream=FAST)
        else:
            source.arrive(at_us, markers(-number, timestamp_us))
    assert source.numbers()[0 if forgotten else 3 :] == sent


def test_nothing_from_before_a_pause_is_sent_after_it() -> None:
    """The present frame of a client that asks now is a new one, with new samples."""
    source = Source(played=3)
    source.arrive(40_000, analog(4, 40_000), stream=FAST)  # a sample that no frame has taken
    source.arrive(40_001, markers(5, 50_000))  # a frame that waits
    source.add(40_002, analog(6, 60_000), stream=FAST)  # not looked at yet
    source.frames.forget()
    assert source.frames.update(40_003) is source.frames.update(400_000) is None  # no timer is set any more
    assert source.numbers() == []
    source.arrivals.frames.clear()
    source.arrive(500_000, markers(7, 70_000))
    source.frames.update(800_000)
    assert source.numbers() == []  # as the samples have yet to begin
    source.arrive(800_001, analog(8, 80_000), stream=FAST)
    source.arrive(800_002, markers(8, 80_000))
    assert source.numbers() == [[8, 8]]


# What is not known yet ----------------------------------------------------------------------


@pytest.mark.parametrize(("announced_hz", "until_us"), [({}, 110_000), ({"ANALOG": 1000.0}, 310_000)])
def test_frames_wait_until_streams_are_known(announced_hz: dict[str, Any], until_us: int) -> None:
    """For 0.1 s, or for 0.3 s if the server announces more than has come."""
    source = Source(is_new=True, **announced_hz)
    assert source.frames.update(5) is None  # nothing waits
    assert source.arrive(10_000, markers(1, 10_000)) == until_us
    assert source.frames.update(until_us - 1) == until_us
    assert source.numbers() == []
    assert source.frames.update(until_us) is None
    assert source.numbers() == [[1]]
    forgotten = Source(is_new=True, **announced_hz)
    forgotten.arrive(10_000, markers(1, 10_000))
    forgotten.forget()
    forgotten.frames.update(500_000)
    assert forgotten.numbers() == []
