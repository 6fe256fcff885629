"""The example programs that read LCM's packets themselves: fragments, and packets that are no messages."""

import os
import re
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import Final

import lcm
import pytest

from tests.support.errors import names
from tests.support.example_programs import EXAMPLES, PROGRAMS, ExampleProgram
from tests.support.takes import markers

pytestmark = pytest.mark.netns

GROUP: Final = ("239.255.76.67", 7713)
LCM_URL: Final = f"udpm://{GROUP[0]}:{GROUP[1]}?ttl=0"
# What a test sends at once fits into a receive buffer of 400 kB, so a slow program loses nothing.
CHANNEL, SMALL = markers(3, 1)
_, LARGE = markers(5000, 2)  # 80 kB: two fragments
_NAMES: Final = {"C#, LCM", "Go, LCM", "Rust, LCM", "JavaScript, LCM"}
each_program = pytest.mark.parametrize("program", [each for each in PROGRAMS if each.name in _NAMES], ids=str)


@contextmanager
def listening(program: ExampleProgram, count: int) -> Iterator["subprocess.Popen[str]"]:
    """Start a program that ends after this many frames."""
    program.build()
    with subprocess.Popen(
        [*program.command, "LAB", str(count)], env={**os.environ, "LCM_DEFAULT_URL": LCM_URL}, cwd=EXAMPLES,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "listening\n"
            yield process
        finally:
            process.kill()


def multicast() -> socket.socket:
    """Return a socket that sends to the group, from a port of its own."""
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
    sender.connect(GROUP)
    return sender


def whole(channel: bytes, data: bytes, sequence: int = 0) -> bytes:
    return struct.pack(">II", 0x4C433032, sequence) + channel + b"\0" + data


def fragments(data: bytes, sequence: int = 0, size: int = 20_000) -> list[bytes]:
    """Return the packets of a message on CHANNEL."""
    places = range(0, len(data), size)
    return [
        struct.pack(">IIIIHH", 0x4C433033, sequence, len(data), place, number, len(places))
        + (CHANNEL.encode() + b"\0" if number == 0 else b"")
        + data[place : place + size]
        for number, place in enumerate(places)
    ]


@each_program
def test_fragments_of_two_senders_may_alternate_in_any_order(program: ExampleProgram) -> None:
    other = markers(4500, 7)[1]
    packets = zip_longest(fragments(LARGE)[::-1], fragments(other, size=15_000))
    with listening(program, 2) as process, multicast() as first, multicast() as second:
        for ours, theirs in packets:
            for sender, packet in ((first, ours), (second, theirs)):
                if packet:
                    sender.send(packet)
                    sender.send(packet)
        text = process.communicate(timeout=120)[0]
    assert set(re.findall(r"#(\d+) frame .* (\d+) markers", text)) == {("2", "5000"), ("7", "4500")}


HOSTILE: Final = (
    b"", b"L", b"LC02", b"LC03", b"LC02\0\0\0", whole(b"", b""), b"LC02\0\0\0\0" + CHANNEL.encode(),
    whole(CHANNEL.encode() * 1000, b"x"), whole(b"\xff\xfe", b"x"), b"XXXX" + bytes(60_000),
    *(b"LC03" + bytes(length) for length in (0, 4, 15, 16, 17)),
    *(
        struct.pack(">IIIIHH", 0x4C433033, 1, *numbers) + rest
        for numbers, rest in (
            ((0xFFFFFFFF, 0, 0, 2), b"c\0x"), ((0x7FFFFFFF, 0, 0, 2), b"c\0x"),
            ((100, 0xFFFFFFFF, 1, 2), b"x"), ((100, 99, 1, 2), b"xx"),
            ((100, 0, 0xFFFF, 2), b"x"), ((100, 0, 0, 0), b"c\0x"), ((100, 0, 0, 2), b"without an end"),
        )
    ),
    *fragments(LARGE, 3)[:-1],
)  # fmt: skip
"""Packets of which no message comes: too short, too long, contradictory, incomplete."""


@each_program
def test_packets_that_are_no_messages_are_ignored(program: ExampleProgram) -> None:
    with listening(program, 1) as process, multicast() as sender:
        for packet in HOSTILE:
            sender.send(packet)
        sender.send(whole(CHANNEL.encode(), SMALL))
        text, errors = process.communicate(timeout=120)
    assert text.startswith("#1 frame 1 at 0.0100 s with parameters 1: 3 of 3 markers in view")
    assert errors == ""


def data_kb(process: "subprocess.Popen[str]") -> int:
    """Return the size of a program's memory, whether or not it has written to it."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(re.findall(r"VmData:\s+(\d+) kB", status)[0])


@each_program
def test_many_senders_of_incomplete_messages_do_not_fill_the_memory(program: ExampleProgram) -> None:
    [beginning, *_] = fragments(bytes(1_000_000), size=100)
    with listening(program, 1) as process, multicast() as other:
        before_kb = data_kb(process)
        for _ in range(10):
            for _ in range(300):  # as many as the receive buffer holds, if the program is slow
                with multicast() as sender:
                    sender.send(beginning)
            other.send(whole(CHANNEL.encode(), b"x"))
            assert process.stderr is not None
            assert names(process.stderr.readline(), "malformed", CHANNEL)
        used_kb = data_kb(process) - before_kb
        other.send(whole(CHANNEL.encode(), SMALL))
        process.communicate(timeout=120)
    assert used_kb < 1_000_000


@each_program
def test_messages_of_a_real_publisher_are_joined_and_malformed_ones_are_reported(
    program: ExampleProgram,
) -> None:
    with listening(program, 3) as process:
        publisher = lcm.LCM(LCM_URL)
        for message in (SMALL, b"", b"x", SMALL[:-1], LARGE, SMALL + b"x", LARGE[:-1], SMALL):
            publisher.publish(CHANNEL, message)
        text, errors = process.communicate(timeout=120)
    assert re.findall(r": (\d+ of \d+) markers", text) == ["3 of 3", "5000 of 5000", "3 of 3"]
    assert process.returncode == 0
    places = [line.partition(":")[0] for line in errors.splitlines()]
    assert places == [f"ignored a malformed message on {CHANNEL}"] * 5


@each_program
@pytest.mark.parametrize(
    ("arguments", "url", "expected"),
    [
        (["--help"], LCM_URL, 0),
        (["--nonsense"], LCM_URL, 2),
        *((["LAB", count], LCM_URL, 1) for count in ("many", "-1")),
        *(([], f"udpm://{address}", 1) for address in ("nonsense", "239.255.76.67:99999", "127.0.0.1:7713")),
        ([], "tcpq://127.0.0.1:7700", 1),
    ],
)
def test_wrong_arguments_end_with_a_sentence(
    program: ExampleProgram, arguments: list[str], url: str, expected: int
) -> None:
    program.build()
    run = subprocess.run(
        [*program.command, *arguments], env={**os.environ, "LCM_DEFAULT_URL": url}, cwd=EXAMPLES,
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert run.returncode == expected
    assert (run.stdout + run.stderr).strip()
    assert "panic" not in run.stderr
    assert "    at " not in run.stderr
