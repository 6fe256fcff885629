"""Sequence numbers: assigned when a frame arrives, so that every gap is loss."""

from collections.abc import Sequence

import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import QueryError
from gateway.messages.decode import decode
from gateway.messages.encode import encode_message
from gateway.messages.history import FoundMessages, MessageHistory, WantedMessages, sequence_of
from gateway.publish.fan_out import FanOut
from gateway.session.ingest import Ingest
from gateway.session.status import StreamStatus
from tests.support.statuses import amounts
from tests.support.toy_output import ToyOutput
from tests.unit.publish.rig import (
    ALL,
    EVENT,
    MARKERS,
    NO_ROUTER,
    PERIOD_US,
    TOOLS,
    UTIME,
    FrameOutput,
    frame,
    numbered,
    publish,
    sequences,
    stamp,
)

SKIPPABLE = ALL - {EVENT}
EVENTS = frozenset({EVENT})


def skip(fan_out: FanOut, *numbers: int) -> int:
    return sum(fan_out.skip(frame(number), stamp(number), SKIPPABLE) for number in numbers)


def num_missing(sequences: list[int]) -> int:
    """Return the sum of the gaps."""
    return sequences[-1] - sequences[0] + 1 - len(sequences)


def test_all_outputs_get_the_same_message_object() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    publish(FanOut("lab", outputs), 1)
    [first, second] = [[message for _, message in output.messages] for output in outputs]
    assert len(first) == 2
    assert all(one is two for one, two in zip(first, second, strict=True))


def test_an_output_that_is_added_joins_the_numbers_of_the_others() -> None:
    one, two = ToyOutput("one"), ToyOutput("two")
    fan_out = FanOut("lab", [one])
    publish(fan_out, 1, 2)
    fan_out.set_outputs([one, two])
    publish(fan_out, 3)
    assert numbered(one, "3d") == [(0, 1), (1, 2), (2, 3)]
    assert numbered(two, "3d") == [(2, 3)]


def test_skipped_frames_are_a_gap_on_every_output() -> None:
    outputs = [ToyOutput("one"), ToyOutput("two")]
    fan_out = FanOut("lab", outputs)
    publish(fan_out, 1)
    assert skip(fan_out, 2, 3) == 4
    publish(fan_out, 4)
    for output in outputs:
        assert numbered(output, "3d") == numbered(output, "6d") == [(0, 1), (3, 4)]
        assert output.messages[-1][1] == encode_message(frame(4).components[1], stamp(4), 3)


def test_only_the_skipped_components_are_a_gap() -> None:
    output = ToyOutput()
    fan_out = FanOut("lab", [output])
    both = frame(1, MARKERS, EVENT)
    for _ in range(2):
        fan_out.publish(both, stamp(1), EVENTS)
        assert fan_out.skip(both, stamp(1), SKIPPABLE) == 1
    fan_out.publish(both, stamp(1), ALL)
    assert sequences(output, "event") == [0, 1, 2]
    assert sequences(output, "3d") == [2]


def test_what_pacing_leaves_out_is_no_gap_and_what_is_skipped_beyond_that_is_one() -> None:
    paced = ToyOutput("paced")
    paced.max_rate_hz = {MARKERS: 50.0, TOOLS: 50.0}
    fan_out = FanOut("lab", [paced])
    publish(fan_out, *range(10))
    assert skip(fan_out, *range(10, 20)) == 10  # of ten frames with two components, five were due
    publish(fan_out, *range(20, 24))
    expected = [(0, 0), (1, 2), (2, 4), (3, 6), (4, 8), (10, 20), (11, 22)]
    assert numbered(paced, "3d") == numbered(paced, "6d") == expected


async def test_the_history_has_the_numbers_of_the_output_that_asks() -> None:
    """Also those of messages that were skipped, so that a subscriber can fill the gap that they leave."""
    paced, unpaced = ToyOutput("paced"), ToyOutput("unpaced")
    paced.max_rate_hz = {MARKERS: 50.0}
    fan_out = FanOut("lab", [paced, unpaced])
    fan_out.history.set_limits(60, 1 << 20)
    publish(fan_out, *range(6))
    skip(fan_out, 6, 7)
    publish(fan_out, *range(8, 10))
    for output, number in ((paced, 5), (unpaced, 10)):
        found = await fan_out.find("3d", output.name, WantedMessages(0))
        assert found is not None
        assert [sequence_of(message) for message in found.messages] == list(range(number))
        assert set(found.messages) >= {message for topic, message in output.messages if topic.path == ("3d",)}
    fan_out.publish_status(b"s" * 48)
    fan_out.publish_clock(b"c" * 48)
    assert fan_out.history.overview["keys"].keys() == {"3d", "6d", "3d on paced", "status", "clock"}


class Disk(ToyOutput):
    """An output that has had messages of markers on a disk for longer than the memory; it may fail."""

    def __init__(self) -> None:
        super().__init__("disk")
        self.recorded = MessageHistory()
        self.recorded.set_limits(1e9, 1 << 30)
        self.code = ""
        self.part: FoundMessages | None = None
        """What it has read until now, if it is slow."""

    async def recorded_messages(self, _source: str, key: str, wanted: WantedMessages) -> FoundMessages | None:
        if self.code:
            raise QueryError("the disk fails", code=self.code)
        return self.part or self.recorded.find(key, wanted)

    def oldest_recorded(self, _source: str, key: str) -> tuple[int, int] | None:
        keys = self.recorded.overview["keys"]
        return (keys[key]["oldest"], keys[key]["oldest_utime"]) if key in keys else None


async def test_what_is_older_than_the_memory_comes_from_the_disk_up_to_what_is_in_memory() -> None:
    """Nothing in between is left out; a paced output has other numbers, so the disk has nothing for it."""
    disk, paced = Disk(), ToyOutput("paced")
    paced.max_rate_hz = {MARKERS: 50.0}
    fan_out = FanOut("lab", [disk, paced])
    fan_out.history.set_limits(60, 1 << 20)
    publish(fan_out, *range(8))
    for topic, message in disk.messages:
        disk.recorded.add(topic.path[0], message)
    fan_out.history.set_limits(60, 0)
    fan_out.history.set_limits(60, 1 << 20)
    only_on_disk = await fan_out.find("3d", "zenoh", WantedMessages(6))
    publish(fan_out, 8, 9)

    async def numbers(wanted: WantedMessages, output: str = "zenoh") -> tuple[list[int], Sequence[int]]:
        found = await fan_out.find("3d", output, wanted)
        assert found is not None
        return [sequence_of(message) for message in found.messages], found[1:]

    assert only_on_disk is not None
    assert only_on_disk[1:] == (6, 7, 0, 7)
    assert await numbers(WantedMessages(2)) == ([2, 3, 4, 5, 6, 7], (2, 7, 0, 9))
    assert await numbers(WantedMessages(2, None, 4)) == ([2, 3, 4], (2, 4, 0, 9))
    assert await numbers(WantedMessages(None, 0)) == ([*range(8)], (0, 7, 0, 9))
    assert await numbers(WantedMessages(8)) == ([8, 9], (8, 9, 0, 9))
    _, (_, _, oldest, _) = await numbers(WantedMessages(0), "paced")
    assert oldest > 0
    assert fan_out.history_overview["keys"]["3d"]["oldest"] == 0
    disk.part = FoundMessages([], 2, 3, 0, 7)
    assert await numbers(WantedMessages(2)) == ([], (2, 3, 0, 9))
    disk.part = FoundMessages([], 4, 3, 0, 7)
    assert await numbers(WantedMessages(None, 0)) == ([], (4, 3, 0, 9))
    assert (await numbers(WantedMessages(4)))[0] == [8, 9]  # there is nothing more on the disk
    disk.code = "disk"
    assert (await numbers(WantedMessages(2)))[0] == [8, 9]
    disk.code = "busy"
    with pytest.raises(QueryError):
        await numbers(WantedMessages(2))


def test_a_skipped_message_is_lost_if_one_output_would_have_got_it() -> None:
    paced, unpaced = ToyOutput("paced"), ToyOutput("unpaced")
    paced.max_rate_hz = {MARKERS: 0.001, TOOLS: 0.001}
    fan_out = FanOut("lab", [paced])
    publish(fan_out, 1)
    assert skip(fan_out, 2) == 0
    fan_out.set_outputs([paced, unpaced])
    assert skip(fan_out, 3) == 2


def test_paced_and_unpaced_routes_to_replaced_outputs_never_go_back() -> None:
    unpaced, paced, again = ToyOutput(), ToyOutput(), ToyOutput()
    paced.max_rate_hz = {MARKERS: 50.0}
    found: list[int] = []
    fan_out = FanOut("lab", [unpaced])
    for first, output in ((0, unpaced), (10, paced), (20, again), (30, paced), (40, unpaced)):
        output.messages.clear()
        fan_out.set_outputs([output])
        publish(fan_out, *range(first, first + 10))
        found += sequences(output, "3d")
    assert found == [*range(10), *range(10, 15), *range(20, 30), *range(30, 35), *range(40, 50)]


def test_a_paced_route_that_is_replaced_by_a_paced_one_continues_its_numbers() -> None:
    before, after = ToyOutput(), ToyOutput()
    before.max_rate_hz = after.max_rate_hz = {MARKERS: 50.0}
    fan_out = FanOut("lab", [before])
    publish(fan_out, *range(10))
    fan_out.set_outputs([after])
    publish(fan_out, 10)
    assert numbered(after, "3d") == [(5, 10)]


def test_a_refused_message_is_a_gap_only_on_the_output_that_refused_it() -> None:
    refusing, accepting = ToyOutput("refusing"), ToyOutput("accepting")
    fan_out = FanOut("lab", [refusing, accepting])
    for number, error in ((1, None), (2, NO_ROUTER), (3, None)):
        refusing.error = error
        publish(fan_out, number)
    assert numbered(refusing, "3d") == [(0, 1), (2, 3)]
    assert numbered(accepting, "3d") == [(0, 1), (1, 2), (2, 3)]


def test_poses_without_a_subscriber_are_no_gap_and_skipped_ones_are() -> None:
    output = ToyOutput("toy", "tool 1", has_tool_poses=True)
    fan_out = FanOut("lab", [output])
    publish(fan_out, 1)
    output.wanted = set()
    publish(fan_out, 2)
    skip(fan_out, 3)
    output.wanted = {"tool 1"}
    publish(fan_out, 4)
    skip(fan_out, 5, 6)
    publish(fan_out, 7)
    assert numbered(output, "6d", "tool 1") == [(0, 1), (1, 4), (4, 7)]


def newest(fan_out: FanOut, output: str) -> tuple[int, int]:
    """Return (sequence, frame number) of the newest 3D message."""
    message = decode(fan_out.newest(MARKERS, output) or b"")
    return message.sequence, message.frame_number


def test_the_newest_message_is_the_newest_that_arrived_with_the_number_of_the_asked_output() -> None:
    unpaced, paced, whole = ToyOutput("unpaced"), ToyOutput("paced"), FrameOutput("whole")
    paced.max_rate_hz = {MARKERS: 50.0}
    fan_out = FanOut("lab", [unpaced, paced, whole])
    assert fan_out.newest(MARKERS, "unpaced") is None
    for number, of_paced in ((0, 0), (1, 0), (2, 1), (3, 1), (4, 2)):
        publish(fan_out, number)
        assert newest(fan_out, "paced") == (of_paced, number)
        assert newest(fan_out, "unpaced") == newest(fan_out, "whole") == (number, number)
    assert (
        fan_out.newest(MARKERS, "paced")
        == [data for topic, data in paced.messages if topic.path == ("3d",)][-1]
    )
    skip(fan_out, 5)
    assert newest(fan_out, "unpaced") == (5, 5)


@pytest.mark.parametrize("rate_hz", [None, 40.0])
def test_missing_frames_are_the_gaps_and_the_count_of_skipped_messages(rate_hz: float | None) -> None:
    """Frames arrive in batches, some late: with ``backlog: latest``, all but the newest are skipped."""
    whole, paced = ToyOutput("whole", "tool 1", has_tool_poses=True), ToyOutput("paced")
    paced.max_rate_hz = {} if rate_hz is None else {MARKERS: rate_hz, TOOLS: rate_hz}
    fan_out = FanOut("lab", [whole, paced])
    status = StreamStatus("all", name="lab (all)")
    ingest = Ingest(
        SourceSettings(name="lab", host="192.0.2.20"),
        StreamSettings(backlog="latest"),
        status,
        fan_out.publish,
        fan_out.skip,
        lambda _halvings: None,
        lambda: None,
    )
    number = 0
    for batch in range(200):
        late_us = 150_000 if 60 <= batch < 160 and batch % 4 else 0
        frames = [frame(number + index) for index in range(1 + 5 * (batch % 3))]
        if batch % 7 == 0:
            frames[0] = frame(number, MARKERS, TOOLS, EVENT)
        number += len(frames)
        utime = UTIME + PERIOD_US * (number - 1) + late_us
        ingest.receive(frames, utime, utime - UTIME)

    (lost_messages, skipped_frames) = amounts(status.losses.report())["skipped while behind"]
    assert lost_messages == 3 * skipped_frames > 100  # 3D, 6D and one pose
    for path in (("3d",), ("6d",), ("6d", "tool 1")):
        published = numbered(whole, *path)
        assert published[0] == (0, 0)
        assert (
            number - len(published) == num_missing([sequence for sequence, _ in published]) == skipped_frames
        )
    events = numbered(whole, "event")
    assert [sequence for sequence, _ in events] == list(range(len(events)))
    assert len(events) == 29
    gaps = num_missing(sequences(paced, "3d"))
    assert gaps == skipped_frames if rate_hz is None else 0 < gaps < skipped_frames
