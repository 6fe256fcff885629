"""The places from which a seek reads: few enough for memory, near enough to be quick."""

from pathlib import Path

import pytest

from gateway.replay.play_list import Selection, play_list
from gateway.replay.seek_index import STEP_US, SeekIndex, SeekPoint
from gateway.replay.timeline import ReplayTimeline, TimelineState
from gateway.takes.reader import FIRST_PLACE, TakeReader
from tests.takes import markers, parameters, write_take

XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"


def point(position_us: int) -> SeekPoint:
    return SeekPoint(FIRST_PLACE, TimelineState(position_us, {}, 0), {})


@pytest.mark.parametrize(
    ("position_us", "expected"), [(0, None), (1, 0), (3_000_000, 0), (3_000_001, 1), (9_000_000, 1)]
)
def test_a_seek_begins_strictly_before_its_target(position_us: int, expected: int | None) -> None:
    """Several messages have the same position: the place may be after the first of them."""
    index = SeekIndex()
    points = [point(0), point(3_000_000)]
    for each in points:
        index.add(each)
    assert index.before(position_us) == (None if expected is None else points[expected])
    assert index.next_us == 3_000_000 + STEP_US
    assert SeekIndex().before(10**9) is None


def test_a_pass_adds_a_place_every_two_seconds_and_a_second_pass_none(tmp_path: Path) -> None:
    """A place for each message would take as much memory as the take."""

    class NotingIndex(SeekIndex):
        positions: list[int] = []  # noqa: RUF012 - one index in this test

        def add(self, point: SeekPoint) -> None:
            self.positions.append(point.timeline.position_us)
            super().add(point)

    messages = [parameters(XML), *(markers(1, number) for number in range(1001))]
    reader, index = TakeReader(write_take(tmp_path / "take.lcmlog", messages)), NotingIndex()
    for _ in range(2):
        assert len([*play_list(reader, Selection(), ReplayTimeline(), 0, index)]) == 1002
    assert index.positions == [*range(0, 10_000_000, STEP_US)]
