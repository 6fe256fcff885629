"""Event logs: their bytes are LCM's own, and damage costs only what it touches."""

import os
import random
from pathlib import Path

import lcm
import pytest

from gateway.errors import TakeError
from gateway.takes.files.event_log import MAX_LISTED_DAMAGE, SYNC, EventBoundary, EventColumns, EventLogReader
from tests.support.takes import encode_event

HEADER_BYTES = 28
MESSAGES = [
    (number, 1_000_000 + 5000 * number, b"MOCAP_LAB_3D", bytes(8) + os.urandom(92)) for number in range(500)
]
EVENTS = [encode_event(*message) for message in MESSAGES]


EXPECTED = [(number, utime, channel.decode(), message) for number, utime, channel, message in MESSAGES]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "take.lcmlog"


def read(path: Path) -> tuple[list[tuple[int, int, str, bytes]], EventLogReader]:
    """Return the events; those that are collected by channel are the same."""
    reader = EventLogReader(path)
    events = [event[:4] for event in reader.events()]
    damage = reader.damage
    columns: dict[bytes, EventColumns] = {}
    collected = []
    for event in filter(None, reader.collect(columns)):
        collected.append((event.utime, event.channel, event.message))
        columns.setdefault(event.channel.encode() + event.message[:8], EventColumns([], []))
    for key, (utimes, messages) in columns.items():
        collected += [(utime, key[:-8].decode(), data) for utime, data in zip(utimes, messages, strict=True)]
    assert sorted(collected) == sorted(event[1:] for event in events)
    assert (reader.damage, reader.offset) == (damage, path.stat().st_size)
    return events, reader


def numbers(path: Path) -> list[int]:
    return [number for number, *_ in read(path)[0]]


def test_an_event_has_the_bytes_of_lcms_event_log(path: Path) -> None:
    """Every tool for LCM's logs reads ours."""
    # Sync word, event number 7, time 258 µs, channel of 1 byte, message of 3 bytes.
    header = "eda1da01 0000000000000007 0000000000000102 00000001 00000003"
    assert encode_event(7, 258, b"C", b"abc") == bytes.fromhex(f"{header} 43 616263")
    path.write_bytes(b"".join(EVENTS))
    events = lcm.EventLog(str(path))
    assert [(each.eventnum, each.timestamp, each.channel, each.data) for each in events] == EXPECTED


def test_the_reader_returns_what_lcm_has_written(path: Path) -> None:
    """Logs of lcm-logger are takes, too."""
    log = lcm.EventLog(str(path), "w")
    for _, utime, channel, message in EXPECTED:
        log.write_event(utime, channel, message)
    log.close()
    events, reader = read(path)
    assert events == EXPECTED
    assert reader.damage == []


@pytest.mark.parametrize("seed", range(20))
def test_damage_costs_only_the_events_that_it_touches(path: Path, seed: int) -> None:
    """Every event before and after it is read, whatever the damage is."""
    choice = random.Random(seed)
    first = choice.randrange(len(EVENTS) - 50)
    last = first + choice.randrange(1, 40)
    damaged = b"".join(EVENTS[first:last])
    begin, end = choice.randrange(HEADER_BYTES), len(damaged) - choice.randrange(HEADER_BYTES)
    kept = choice.choice([b"", choice.randbytes(end - begin), bytes(end - begin), choice.randbytes(9)])
    damaged = damaged[:begin] + kept + damaged[end:]
    path.write_bytes(b"".join(EVENTS[:first]) + damaged + b"".join(EVENTS[last:]))
    events, reader = read(path)
    assert {*range(first), *range(last, len(EVENTS))} <= {number for number, *_ in events}
    assert reader.num_damaged == 1
    assert 0 < reader.damaged_bytes <= len(damaged)


def test_a_truncated_log_keeps_every_complete_event(path: Path) -> None:
    """So ends each log whose recorder was killed."""
    path.write_bytes(b"".join(EVENTS)[:-1])
    events, reader = read(path)
    assert events == EXPECTED[:-1]
    assert reader.damaged_bytes == len(EVENTS[-1]) - 1


@pytest.mark.parametrize("content", [b"", b"x", bytes(5_000_000), EVENTS[0][:-1], b"\x89PNG\r\n" * 100])
def test_a_file_without_events_is_no_log(path: Path, content: bytes) -> None:
    """A wrong file is an error at once, not an empty take."""
    path.write_bytes(content)
    with pytest.raises(TakeError, match=r"take\.lcmlog (has|is)"):
        read(path)


@pytest.mark.parametrize("more", [-50, -1, 1, 3, 27, 29, 500, 10**6, 2**31 - 1])
def test_a_damaged_size_costs_one_event(path: Path, more: int) -> None:
    """A size that is too large must not swallow what follows."""
    size = len(MESSAGES[3][3]) + more
    damaged = EVENTS[3][:24] + (size & 0xFFFFFFFF).to_bytes(4, "big") + EVENTS[3][28:]
    path.write_bytes(b"".join([*EVENTS[:3], damaged, *EVENTS[4:]]))
    assert [number for number in numbers(path) if number != 3] == [0, 1, 2, *range(4, 500)]


@pytest.mark.parametrize("before", [b"", SYNC, SYNC * 3, SYNC + bytes(30), SYNC + b"\xff" * 40])
def test_an_event_that_lost_its_end_does_not_hide_those_that_follow(path: Path, before: bytes) -> None:
    """Its content may have sync words, too: each must be tried until one begins an event."""
    broken = encode_event(1, 1, b"MOCAP_LAB_3D", before + bytes(1000))[: 28 + 12 + len(before) + 5]
    path.write_bytes(EVENTS[0] + broken + b"".join(EVENTS[2:20]))
    events, reader = read(path)
    assert [number for number, *_ in events] == [0, *range(2, 20)]
    assert reader.damaged_bytes == len(broken)


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize(("size", "is_read"), [(0, False), (1, True), (255, True), (256, False)])
def test_channels_have_1_to_255_bytes(path: Path, size: int, is_read: bool, last: bool) -> None:
    """A longer one is damage, and the search for the next event begins at once."""
    event = encode_event(1, 1, b"c" * size, b"message")
    path.write_bytes(EVENTS[0] + event + (b"" if last else EVENTS[2] + EVENTS[3]))
    assert numbers(path).count(1) == is_read


def test_all_damage_is_counted_and_some_of_it_listed(path: Path) -> None:
    """A disk with thousands of bad places must not fill the memory, or the report."""
    path.write_bytes(b"damage".join(EVENTS[:130]))
    events, reader = read(path)
    assert len(events) == 130
    assert (len(reader.damage), reader.num_damaged) == (MAX_LISTED_DAMAGE, 129)
    assert reader.damaged_bytes == 129 * 6
    size = len(EVENTS[0])
    assert [reader.damage[number][1:] for number in (0, 99)] == [(size, 6), (100 * size + 99 * 6, 6)]
    assert [event.number for event in reader.events(reader.damage[98].offset)] == [*range(99, 130)]
    assert reader.num_damaged == 31  # of the newest pass


# The end of the last complete event in bytes that arrive in pieces ----------------------------

SHORT_EVENTS = [encode_event(number, number, b"MOCAP_LAB_3D", b"x" * number) for number in range(50)]
LOG = b"".join(SHORT_EVENTS)


@pytest.mark.parametrize("size", [1, 7, 28, 29, 41, 1000, len(LOG)])
def test_the_boundary_is_found_in_pieces_of_any_size(size: int) -> None:
    """A copy that breaks off ends with a whole event, and goes on there."""
    for end in (0, 1, 27, 28, len(SHORT_EVENTS[0]) - 1, len(SHORT_EVENTS[0]), len(LOG) - 1, len(LOG)):
        boundary = EventBoundary()
        for start in range(0, end, size):
            boundary.feed(LOG[start : min(start + size, end)])
        sizes = [sum(map(len, SHORT_EVENTS[:number])) for number in range(len(SHORT_EVENTS) + 1)]
        assert boundary.complete_bytes == max(each for each in sizes if each <= end)


def test_after_damage_everything_counts() -> None:
    """A damaged take is copied as it is."""
    boundary = EventBoundary()
    boundary.feed(LOG + b"damage" * 10)
    boundary.feed(LOG[:-1])
    assert boundary.complete_bytes == 2 * len(LOG) + 59
