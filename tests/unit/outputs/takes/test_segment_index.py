"""Messages of a key are found again in the rolling segments: all of a range, and little else is read."""

from pathlib import Path
from typing import Any

import pytest
import rtc3d
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.messages.history import MAX_ANSWER_BYTES, FoundMessages, WantedMessages, sequence_of
from gateway.messages.topics import Topic
from gateway.outputs.takes import segment_index
from gateway.takes.files import event_log
from tests.support.clocks import Clock
from tests.support.examples import examples
from tests.support.recording_output import RecordingLab, still_lab


def message(sequence: int, utime: int = 0, markers: int = 0) -> bytes:
    made = rtc3d.markers_t()
    made.sequence, made.utime, made.num_markers = sequence, utime, markers
    made.markers = [rtc3d.marker_t() for _ in range(markers)]
    return bytes(made.encode())


async def read_all(lab: RecordingLab, key: str, wanted: WantedMessages) -> list[bytes]:
    """Return messages as a subscriber gets them, piece by piece."""
    messages: list[bytes] = []
    while (found := await lab.output.recorded_messages("lab", key, wanted)) is not None:
        assert sum(map(len, found.messages)) <= MAX_ANSWER_BYTES or len(found.messages) == 1
        messages += found.messages
        end = found.newest if wanted.last is None else min(wanted.last, found.newest)
        if found.last >= end:
            break
        wanted = WantedMessages(found.last + 1, None, wanted.last)
    return messages


STEPS = st.lists(
    st.tuples(
        st.sampled_from(["3d", "3d", "event"]), st.integers(1, 40), st.sampled_from([0, 5, 12]), st.booleans()
    ),
    min_size=1,
    max_size=12,
)


@settings(
    max_examples=examples(40), suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(STEPS, st.integers(0, 200), st.none() | st.integers(0, 200), st.booleans())
async def test_a_range_has_every_message_of_its_key_in_order(
    tmp_path_factory: pytest.TempPathFactory,
    steps: list[tuple[str, int, int, bool]],
    first: int,
    last: int | None,
    by_time: bool,
) -> None:
    """Whatever the messages between them, the ends of segments, the messages lost before, and the pieces."""
    clock = Clock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment_index, "STRETCH_BYTES", 1000)
        patch.setattr(segment_index, "MAX_READ_BYTES", 4000)
        patch.setattr(segment_index, "MAX_ANSWER_BYTES", 3000)
        async with still_lab(tmp_path_factory.mktemp("takes"), clock, keep_last_s=600.0) as lab:
            published: dict[str, list[bytes]] = {"3d": [], "event": []}
            numbers = {"3d": 0, "event": 0}
            for key, count, seconds, is_lost in steps:
                for _ in range(count):
                    each = message(numbers[key], 10 * numbers[key], 3)
                    numbers[key] += 1
                    if not is_lost:
                        lab.publishers[key].publish(each)
                        published[key].append(each)
                await lab.output.storage.written()
                clock.now_s += seconds
            wanted = WantedMessages(None, 10 * first, last) if by_time else WantedMessages(first, None, last)
            for key, messages in published.items():
                expected = [
                    each
                    for each in messages
                    if first <= sequence_of(each) <= (10**9 if last is None else last)
                ]
                assert await read_all(lab, key, wanted) == expected


async def found_in(lab: RecordingLab, key: str, first: int) -> FoundMessages:
    found = await lab.output.recorded_messages("lab", key, WantedMessages(first))
    assert found is not None
    return found


async def test_the_oldest_message_is_that_of_the_oldest_segment_that_is_kept(tmp_path: Path) -> None:
    """A subscriber that asks for more learns that it exists no more."""
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=30.0) as lab:
        assert lab.output.oldest_recorded("lab", "3d") is None
        assert await lab.output.recorded_messages("lab", "3d", WantedMessages(0)) is None
        for number in range(100):
            lab.publishers["3d"].publish(message(number, utime=1000 + number))
            await lab.output.storage.written()
            clock.now_s += 1.0
        found = await found_in(lab, "3d", 0)
        assert 30 <= found.newest - found.oldest <= 50
        assert (found.first, found.last, found.newest) == (0, 99, 99)
        assert [sequence_of(each) for each in found.messages] == [*range(found.oldest, 100)]
        assert lab.output.oldest_recorded("lab", "3d") == (found.oldest, 1000 + found.oldest)
        assert lab.output.oldest_recorded("lab", "event") is None
        assert lab.output.oldest_recorded("hall", "3d") is None


async def test_rare_messages_among_many_cost_little_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The status of a minute must not cost reading the markers of a minute."""
    clock, num_read = Clock(), 0
    async with still_lab(tmp_path, clock, keep_last_s=600.0) as lab:
        status = lab.output.publisher(Topic("lab", ("status",), "rtc3d.status_t"))
        for number in range(20):
            status.publish(message(number))
            for _ in range(100):
                lab.publish("3d", size=500)
            await lab.output.storage.written()
        size = sum(path.stat().st_size for path in (tmp_path / ".rolling" / "lab").iterdir())
        intact = event_log._Window.has

        def has(window: Any, num_bytes: int) -> bool:
            nonlocal num_read
            before = window._file.tell()
            found = intact(window, num_bytes)
            num_read += window._file.tell() - before
            return found

        monkeypatch.setattr(event_log._Window, "has", has)
        assert len(await read_all(lab, "status", WantedMessages(0))) == 20
        whole, num_read = num_read, 0
        assert len((await found_in(lab, "status", 19)).messages) == 1
    assert whole <= size / 5
    assert num_read <= 2**17


async def test_numbers_that_begin_again_and_closed_topics_are_not_mixed(tmp_path: Path) -> None:
    """A tool's channel may get another tool; its poses would look like those of the former one."""
    async with still_lab(tmp_path, keep_last_s=600.0) as lab:
        pose = lab.output.publisher(Topic("lab", ("6d", "Left Foot"), "rtc3d.tool_pose_t"))
        for number in range(5):
            pose.publish(message(number))
        assert len((await found_in(lab, "6d/Left Foot", 0)).messages) == 5
        pose.close()
        assert await lab.output.recorded_messages("lab", "6d/Left Foot", WantedMessages(0)) is None
        other = lab.output.publisher(Topic("lab", ("6d", "left foot"), "rtc3d.tool_pose_t"))
        other.publish(message(7))
        assert [sequence_of(each) for each in (await found_in(lab, "6d/left foot", 0)).messages] == [7]
        other.publish(message(0, utime=1))
        again = await found_in(lab, "6d/left foot", 0)
        assert (again.messages, again.oldest, again.newest) == ([message(0, utime=1)], 0, 0)
        other.publish(message(0, utime=2))  # of yet another run, which has reached the same number
        assert (await found_in(lab, "6d/left foot", 0)).messages == [message(0, utime=2)]


async def test_a_segment_that_somebody_removes_costs_only_its_messages(tmp_path: Path) -> None:
    """The others are on the disk, and are found."""
    clock = Clock()
    async with still_lab(tmp_path, clock, keep_last_s=600.0) as lab:
        for number in range(40):
            lab.publishers["3d"].publish(message(number))
            await lab.output.storage.written()
            clock.now_s += 1.0
        sorted((tmp_path / ".rolling" / "lab").iterdir())[1].unlink()
        found = await found_in(lab, "3d", 5)
        assert [sequence_of(each) for each in found.messages] == [*range(5, 10), *range(20, 40)]


class SlowClock(Clock):
    """Each look at it takes ``step_s``."""

    step_s = 0.0

    def __call__(self) -> float:
        self.now_s += self.step_s
        return self.now_s


@pytest.mark.parametrize(("look_s", "max_read_bytes"), [(0.7 * segment_index.MAX_READ_S, 10**9), (0.0, 3000)])
async def test_one_answer_reads_little_of_a_slow_disk_or_of_a_large_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look_s: float, max_read_bytes: int
) -> None:
    """Otherwise, a subscriber would give up one long answer after the other, and never get a message."""
    monkeypatch.setattr(segment_index, "STRETCH_BYTES", 1000)
    monkeypatch.setattr(segment_index, "MAX_READ_BYTES", max_read_bytes)
    clock = SlowClock()
    async with still_lab(tmp_path, clock, keep_last_s=600.0) as lab:
        for number in range(20):
            lab.publishers["3d"].publish(message(number, markers=20))
            await lab.output.storage.written()
        clock.step_s = look_s
        found = await found_in(lab, "3d", 0)
        assert [sequence_of(each) for each in found.messages] == [*range(found.last + 1)]
        assert 0 < len(found.messages) < 10
        assert [sequence_of(each) for each in await read_all(lab, "3d", WantedMessages(0))] == [*range(20)]
