"""Hostile RTC3D clients. Each attacks the port of a gateway's RT server until it is cancelled."""

import itertools
import os
import struct
from typing import Final

from tests.hostile.port_attacks import Attack, endless, short, silent, stalled
from tests.unit.rtc3d_server.wire import DATA, EVENT, command, packet

NUM_STALLED: Final = 60
NUM_SILENT: Final = 150  # more than are accepted

_START: Final = struct.pack(">IIIiqI", 1, 48, EVENT, -1, 0, 1) + struct.pack(">iqiii", 1, 0, -1, -1, -1)
_WORDS: Final = ("3D", "6D", "Analog", "Force", "Events")
_CHOICES: Final = [
    " ".join(words) for count in range(1, 6) for words in itertools.combinations(_WORDS, count)
]
_FRAME_REQUESTS: Final = b"".join(
    command(f"{verb} {choice}") for choice in _CHOICES for verb in ("StreamFrames", "SendCurrentFrame")
)


def _frames_or_anything() -> bytes:
    return command("StreamFrames") if os.urandom(1)[0] % 2 else os.urandom(2000)


ATTACKS: Final[dict[str, Attack]] = {
    "stalled clients": stalled(NUM_STALLED, command("StreamFrames")),
    "silent connections": silent(NUM_SILENT),
    "short connections": short(_frames_or_anything),
    "commands": endless(b"", command("Version 1.0") * 1000),
    "commands without reading": endless(b"", command("SendParameters") * 1000, reads=False),
    "requests for all choices": endless(b"", _FRAME_REQUESTS),
    "parameters of all choices": endless(
        b"", b"".join(command(f"SendParameters {choice}") for choice in _CHOICES)
    ),
    "recordings": endless(b"", packet(DATA, _START) + command("Recording Start,file=../x") * 10),
    "empty packets": endless(b"", packet(1) * 5000),
    "HTTP": endless(b"", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 1000),
    "an endless packet": endless(b"", struct.pack(">II", 60_000, 1) + b"x" * 50_000),
}
