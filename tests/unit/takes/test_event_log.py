import os
import random
from pathlib import Path

import lcm
import pytest

from gateway.errors import TakeError
from gateway.takes.event_log import EventLogReader, encode_event

HEADER_BYTES = 28
MESSAGES = [(number, 1_000_000 + 5000 * number, b"MOCAP_LAB_3D", os.urandom(100)) for number in range(500)]
EVENTS = [encode_event(*message) for message in MESSAGES]


def expected(messages: list[tuple[int, int, bytes, bytes]]) -> list[tuple[int, int, str, bytes]]:
    return [(number, utime, channel.decode(), message) for number, utime, channel, message in messages]


def read(path: Path) -> tuple[list[tuple[int, int, str, bytes]], EventLogReader]:
    reader = EventLogReader(path)
    return [event[:4] for event in reader.events()], reader


def test_an_event_has_the_bytes_of_lcms_event_log(tmp_path: Path) -> None:
    # Sync word, event number 7, time 258 µs, channel of 1 byte, message of 3 bytes.
    assert encode_event(7, 258, b"C", b"abc") == bytes.fromhex(
        "eda1da01 0000000000000007 0000000000000102 00000001 00000003 43 616263"
    )
    path = tmp_path / "take.lcmlog"
    path.write_bytes(b"".join(EVENTS))
    events = [
        (event.eventnum, event.timestamp, event.channel, event.data) for event in lcm.EventLog(str(path))
    ]
    assert events == expected(MESSAGES)


def test_the_reader_returns_what_lcm_has_written(tmp_path: Path) -> None:
    log = lcm.EventLog(str(tmp_path / "take.lcmlog"), "w")
    for _, utime, channel, message in MESSAGES:
        log.write_event(utime, channel.decode(), message)
    log.close()
    events, reader = read(tmp_path / "take.lcmlog")
    assert events == expected(MESSAGES)
    assert reader.damage == []


@pytest.mark.parametrize("seed", range(20))
def test_damage_costs_only_the_events_that_it_touches(tmp_path: Path, seed: int) -> None:
    choice = random.Random(seed)
    first = choice.randrange(len(EVENTS) - 50)
    last = first + choice.randrange(1, 40)
    damaged = b"".join(EVENTS[first:last])
    begin, end = choice.randrange(HEADER_BYTES), len(damaged) - choice.randrange(HEADER_BYTES)
    kept = choice.choice([b"", choice.randbytes(end - begin), bytes(end - begin), choice.randbytes(9)])
    path = tmp_path / "damaged.lcmlog"
    damaged = damaged[:begin] + kept + damaged[end:]
    path.write_bytes(b"".join(EVENTS[:first]) + damaged + b"".join(EVENTS[last:]))
    events, reader = read(path)
    numbers = {number for number, *_ in events}
    assert set(range(first)) | set(range(last, len(EVENTS))) <= numbers
    assert reader.num_damaged == 1
    assert 0 < reader.damaged_bytes <= len(damaged)


def test_a_truncated_log_keeps_every_complete_event(tmp_path: Path) -> None:
    path = tmp_path / "truncated.lcmlog"
    path.write_bytes(b"".join(EVENTS)[:-1])
    events, reader = read(path)
    assert events == expected(MESSAGES[:-1])
    assert reader.damaged_bytes == len(EVENTS[-1]) - 1


@pytest.mark.parametrize("content", [b"", b"x", bytes(5_000_000), EVENTS[0][:-1], b"\x89PNG\r\n" * 100])
def test_a_file_without_events_is_no_log(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "foreign.lcmlog"
    path.write_bytes(content)
    with pytest.raises(TakeError, match=r"foreign\.lcmlog (has|is)"):
        read(path)


@pytest.mark.parametrize("more", [-50, -1, 1, 3, 27, 29, 500, 10**6, 2**31 - 1])
def test_a_damaged_size_costs_one_event(tmp_path: Path, more: int) -> None:
    size = len(MESSAGES[3][3]) + more
    damaged = EVENTS[3][:24] + (size & 0xFFFFFFFF).to_bytes(4, "big") + EVENTS[3][28:]
    path = tmp_path / "damaged.lcmlog"
    path.write_bytes(b"".join([*EVENTS[:3], damaged, *EVENTS[4:]]))
    events, _ = read(path)
    assert [number for number, *_ in events if number != 3] == [0, 1, 2, *range(4, 500)]
