"""The history returns exactly the messages that it was given and has room for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ProtocolError
from gateway.messages.encode import PREFIX, ComponentEncoder, Stamp
from gateway.messages.frame_run import MessageNumbers, NumberedLayout
from gateway.messages.history import (
    MAX_ANSWER_BYTES,
    MESSAGE_OVERHEAD_BYTES,
    MessageHistory,
    WantedMessages,
    pack_messages,
    sequence_of,
    unpack_messages,
)
from gateway.messages.host_time import HostClock
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.frames import split_frame
from tests.support.clocks import Clock
from tests.support.vectors import FULL_FRAME

FULL = split_frame(FULL_FRAME["big"], "big")


def message(sequence: int, utime: int = 0, size: int = 48) -> bytes:
    return (b"12345678" + PREFIX.pack(utime, utime, sequence, 1, 1)).ljust(size, b".")


def read_all(history: MessageHistory, key: str, wanted: WantedMessages) -> list[int]:
    """Return the numbers of the wanted messages as a subscriber reads them, piece by piece."""
    numbers: list[int] = []
    while (found := history.find(key, wanted)) is not None:
        assert sum(map(len, found.messages)) <= MAX_ANSWER_BYTES or len(found.messages) == 1
        numbers += [sequence_of(each) for each in found.messages]
        assert found.last <= found.newest
        end = found.newest if wanted.last is None else min(wanted.last, found.newest)
        if found.last >= end:
            break
        wanted = WantedMessages(found.last + 1, None, wanted.last)
    return numbers


@given(
    st.lists(
        st.tuples(st.integers(1, 3), st.sampled_from([0.0, 0.3, 1.1]), st.sampled_from([48, 90_000])),
        min_size=1,
        max_size=60,
    ),
    st.integers(0, 130),
    st.none() | st.integers(0, 130),
    st.integers(0, 40),
)
def test_a_range_has_every_message_that_is_kept(
    steps: list[tuple[int, float, int]], first: int, last: int | None, since_s: int
) -> None:
    clock = Clock()
    history = MessageHistory(clock)
    history.set_limits(10.0, 1 << 20)
    sequence = -1
    times: dict[int, float] = {}
    for step, pause_s, size in steps:
        clock.now_s += pause_s
        history.begin_block()
        sequence += step
        times[sequence] = clock.now_s
        history.add("3d", message(sequence, round(1e6 * clock.now_s), size))
        assert history.num_bytes <= (1 << 20) + size + MESSAGE_OVERHEAD_BYTES
    everything = read_all(history, "3d", WantedMessages(0))
    kept = list(times)[-len(everything) :]
    assert everything == kept
    assert all(number in kept for number in times if times[number] > clock.now_s - 9 and len(times) < 10)
    expected = [number for number in kept if first <= number <= (sequence if last is None else last)]
    assert read_all(history, "3d", WantedMessages(first, None, last)) == expected
    since_utime = round(1e6 * since_s)
    expected = [number for number in kept if round(1e6 * times[number]) >= since_utime]
    assert read_all(history, "3d", WantedMessages(None, since_utime)) == expected
    found = history.find("3d", WantedMessages(sequence + 1))
    assert found is not None
    assert (found.messages, found.last, found.oldest, found.newest) == ([], sequence, kept[0], sequence)


def test_old_messages_are_dropped_after_the_time_and_beyond_the_memory() -> None:
    clock = Clock()
    history = MessageHistory(clock)
    history.set_limits(5.0, 100_000)
    history.add("3d", message(0))
    clock.now_s += 5.9
    history.begin_block()
    assert history.find("3d", WantedMessages(0)) is not None
    clock.now_s += 0.2
    history.begin_block()
    assert history.find("3d", WantedMessages(0)) is None
    for sequence in range(1000):
        history.add("3d", message(sequence, size=952))
    found = history.find("3d", WantedMessages(0))
    assert found is not None
    # 100 messages fit; a block is a 32nd of the memory, or a message more.
    assert 1000 - 100 <= found.oldest <= 1000 - 100 + 8
    assert history.overview["num_bytes"] == (1000 - found.oldest) * 1000


def test_a_message_that_is_longer_than_an_answer_may_be_is_an_answer() -> None:
    history = MessageHistory(Clock())
    history.set_limits(5.0, 1 << 20)
    for sequence in range(3):
        history.add("3d", message(sequence, size=MAX_ANSWER_BYTES + 1))
    assert read_all(history, "3d", WantedMessages(0)) == [0, 1, 2]


def test_nothing_is_kept_without_limits_or_after_forgetting() -> None:
    history = MessageHistory(Clock())
    history.add("3d", message(0))
    assert not history.is_kept
    assert history.find("3d", WantedMessages(0)) is None
    history.set_limits(5.0, 100_000)
    history.add("6d/a", message(7, 70))
    history.add("6d/b", message(8, 80))
    history.forget("6d/a")
    numbers = {"oldest": 8, "newest": 8, "oldest_utime": 80, "newest_utime": 80}
    assert history.overview["keys"] == {"6d/b": numbers}
    assert history.num_bytes == 48 + MESSAGE_OVERHEAD_BYTES
    history.set_limits(0.0, 100_000)
    assert history.num_bytes == 0


@given(st.lists(st.binary(min_size=40, max_size=60)), st.integers(1, 43))
def test_packed_messages_are_unpacked_and_a_cut_is_noticed(messages: list[bytes], num_cut: int) -> None:
    payload = pack_messages(messages)
    assert unpack_messages(payload) == messages
    if messages:
        with pytest.raises(ProtocolError):
            unpack_messages(payload[:-num_cut])


class SteppedHost(HostClock):
    """The clocks of a computer whose wall clock somebody sets; ``clock`` is the monotonic one."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.steps = 0
        self.offset_us = 1_700_000_000_000_000

    @property
    def utime(self) -> int:
        return self.offset_us + round(1e6 * self._clock.now_s)

    def read(self) -> tuple[int, int]:
        return self.utime, round(1e6 * self._clock.now_s)

    def step(self, by_s: int) -> None:
        self.offset_us += by_s * 1_000_000
        self.steps += 1


@pytest.mark.interpreted
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.01, 0.3, 1.1, 5.0]),
            st.sampled_from(["", "", "", "maintain", "step"]),
            st.sampled_from([-86_400, -50, -1, 1, 9, 50, 86_400]),
        ),
        min_size=1,
        max_size=60,
    ),
    st.sampled_from([0.05, 1.0, 10.0, 30.0, 1000.0]),
    st.booleans(),
)
def test_the_last_seconds_are_those_of_a_clock_that_nobody_sets(
    steps: list[tuple[float, str, int]],
    last_s: float,
    are_frames: bool,
) -> None:
    """After a step forward, ten seconds were one; after a step back, they were the whole minute."""
    clock = Clock()
    host = SteppedHost(clock)
    history = MessageHistory(clock, host)
    history.set_limits(60.0, 1 << 20)
    markers = MessageNumbers(ComponentType.MARKERS)
    layout = NumberedLayout([(markers, ComponentEncoder(FULL.layout, 0))])
    times: list[float] = []
    for pause_s, work, by_s in steps:
        clock.now_s += pause_s
        if work == "step":
            host.step(by_s)
        elif work == "maintain":
            history.begin_block()
        if are_frames:
            history.add_frame(FULL.body, layout, Stamp(host.utime, host.utime, 1, 1))
            markers.next += 1
        else:
            history.add("3d", message(len(times), host.utime))
        times.append(clock.now_s)
    kept = read_all(history, "3d", WantedMessages(0))
    found = read_all(history, "3d", WantedMessages(None, None, None, last_s))
    certain = {number for number in kept if times[number] >= clock.now_s - last_s + 1e-4}
    possible = {number for number in kept if times[number] >= clock.now_s - last_s - 1e-4}
    assert certain <= {*found} <= possible
    assert found == sorted(found)


@pytest.mark.interpreted
def test_a_message_that_was_dated_before_a_step_and_kept_after_it_is_young() -> None:
    """Another stream may have noticed the step in between."""
    clock = Clock()
    host = SteppedHost(clock)
    history = MessageHistory(clock, host)
    history.set_limits(60.0, 1 << 20)
    for number, by_s in enumerate((1000, -1000)):
        utime = host.utime
        host.step(by_s)
        history.add("3d", message(number, utime))
    clock.now_s += 1
    history.begin_block()
    clock.now_s += 4
    assert read_all(history, "3d", WantedMessages(None, None, None, 6.0)) == [0, 1]
    assert read_all(history, "3d", WantedMessages(None, None, None, 3.9)) == []


@pytest.mark.interpreted
def test_the_disk_is_asked_for_the_time_that_the_clock_showed_before_a_step() -> None:
    clock = Clock()
    host = SteppedHost(clock)
    history = MessageHistory(clock, host)
    history.set_limits(60.0, 1 << 20)
    assert history.utime_before("3d", 10.0) is None
    before = host.utime
    history.add("3d", message(0, before))
    clock.now_s += 5
    host.step(-50)
    history.add("3d", message(1, host.utime))
    assert history.utime_before("3d", 10.0) == before - 5_000_000
