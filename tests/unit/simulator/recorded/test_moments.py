import struct

import pytest

from gateway.rtc3d.components import ComponentType
from gateway.simulator.recorded.moments import Moment, MomentBuilder, Recorded
from gateway.simulator.recorded.parameters import RecordedParameters

START = 1_700_000_000_000_000
MARKERS, TOOLS = ComponentType.MARKERS, ComponentType.TOOLS
ANALOG, EVENT = ComponentType.ANALOG, ComponentType.EVENT
PARAMETERS = RecordedParameters(b"<RT_Parameters/>")
Content = dict[ComponentType, int]


class Take:
    """Components added one after the other, each with another frame number."""

    def __init__(self) -> None:
        self.builder = MomentBuilder()
        self.moments: list[Moment] = []
        self._number = 0

    def add(
        self, kind: ComponentType, time_us: int, capture_us: int = -1, session: int = 1, stamp: bytes = b""
    ) -> None:
        captured = START + (time_us if capture_us == -1 else capture_us)
        self._number += 1
        content = struct.pack(">iqi", self._number, time_us, 0)
        stamp = stamp or self._number.to_bytes(4, "big")
        self.moments += self.builder.add(Recorded(kind, captured, session, stamp, content, PARAMETERS))

    def finish(self) -> list[tuple[int, Content]]:
        """Return the time and the frame numbers of each moment."""
        self.moments += self.builder.finish()
        return [(each.due_us, {k: number_in(v) for k, v in each.contents.items()}) for each in self.moments]


def number_in(content: bytes) -> int:
    return int(struct.unpack_from(">i", content)[0])


def test_components_of_one_time_stamp_or_one_frame_are_one_moment() -> None:
    """Whatever the connection of the first, and whatever the time stamps of the second."""
    expected: list[tuple[int, Content]] = [(0, {MARKERS: 1, ANALOG: 2}), (10_000, {MARKERS: 3, ANALOG: 4})]
    take = Take()
    for timestamp_us in (0, 10_000):
        take.add(MARKERS, timestamp_us, session=1)
        take.add(ANALOG, timestamp_us, session=2, capture_us=timestamp_us + 3000)
    assert take.finish() == expected
    take = Take()
    for number in (0, 1):
        take.add(MARKERS, number * 10_000, stamp=b"%d" % number)
        take.add(ANALOG, number * 10_000 + 300, stamp=b"%d" % number)
    assert take.finish() == expected


def test_a_component_that_arrives_late_on_another_connection_gets_its_place() -> None:
    take = Take()
    for timestamp_us in (0, 10_000, 20_000):
        take.add(MARKERS, timestamp_us, session=1)
    for timestamp_us in (0, 5000, 10_000):
        take.add(ANALOG, timestamp_us, session=2)
    assert take.finish() == [
        (0, {MARKERS: 1, ANALOG: 4}),
        (5000, {ANALOG: 5}),
        (10_000, {MARKERS: 2, ANALOG: 6}),
        (20_000, {MARKERS: 3}),
    ]


@pytest.mark.parametrize("timestamp_us", [0, -1, 77])
def test_with_frozen_time_stamps_each_component_is_in_a_frame_once(timestamp_us: int) -> None:
    take = Take()
    for captured in (0, 10_000, 20_000):
        take.add(MARKERS, timestamp_us, captured, stamp=b"%d" % captured)
        take.add(TOOLS, timestamp_us, captured, stamp=b"%d" % captured)
    frames = [(0, {MARKERS: 1, TOOLS: 2}), (10_000, {MARKERS: 3, TOOLS: 4}), (20_000, {MARKERS: 5, TOOLS: 6})]
    assert take.finish() == frames


def test_the_order_of_a_component_never_changes_and_no_two_moments_have_the_same_time() -> None:
    take = Take()
    stamps = [0, 0, 10_000, 5000, 5000, 3_000_000, 20_000, 2**60, 30_000, -5, 40_000]
    for captured, timestamp_us in enumerate(stamps):
        take.add(ANALOG, timestamp_us, captured * 1000)
    moments = take.finish()
    assert [content[ANALOG] for _, content in moments] == list(range(1, len(stamps) + 1))
    times = [time for time, _ in moments]
    assert times == sorted(set(times))


def test_a_time_stamp_that_returns_after_a_restart_does_not_join_the_old_moment() -> None:
    take = Take()
    take.add(MARKERS, 1000, 0)
    take.add(TOOLS, 1000, 5_000_000, session=2)
    assert [len(content) for _, content in take.finish()] == [1, 1]


def test_a_component_that_comes_after_its_moment_was_released_is_a_moment_of_its_own() -> None:
    """A moment that was released may have been sent already, and must not change any more."""
    take = Take()
    for timestamp_us in (0, 560_000):
        take.add(MARKERS, timestamp_us)
    assert len(take.moments) == 1
    take.add(TOOLS, 0, stamp=b"other")
    assert take.finish() == [(0, {MARKERS: 1}), (1, {TOOLS: 3}), (560_000, {MARKERS: 2})]


def test_moments_are_released_while_the_take_goes_on_even_if_all_have_one_time() -> None:
    for count, kind, period_us, at_once in ((1000, MARKERS, 10_000, 900), (30_000, EVENT, 0, 10_000)):
        take = Take()
        for number in range(count):
            take.add(kind, number * period_us)
        assert at_once < len(take.moments) < count
        assert len(take.finish()) == count
