"""The history returns exactly the messages that it was given and has room for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ProtocolError
from gateway.messages.encode import PREFIX
from gateway.messages.history import (
    MAX_ANSWER_BYTES,
    MESSAGE_OVERHEAD_BYTES,
    MessageHistory,
    WantedMessages,
    pack_messages,
    sequence_of,
    unpack_messages,
)
from tests.support.clocks import Clock


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
