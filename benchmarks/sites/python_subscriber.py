"""The same program as subscriber/main.rs in Python, for machines without cargo: for a few subscribers only.

python -m benchmarks.sites.python_subscriber CONFIG SESSIONS KEY...
"""

import json
import math
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh

from gateway.messages.encode import CONTENT_OFFSET
from gateway.messages.history import sequence_of, utime_of

_BUCKETS_PER_OCTAVE: Final = 16


@dataclass
class _Stream:
    """What one session has received of one key; see main.rs."""

    messages: int = 0
    message_bytes: int = 0
    first: int = 0
    missing: int = 0
    not_newer: int = 0
    longest_silence_us: int = 0
    ages: Counter[int] = field(default_factory=Counter)
    ages_before: Counter[int] = field(default_factory=Counter)
    newest: int | None = None
    newest_utime: int = 0
    received_us: int = 0

    def record(self, now_us: int, message: bytes) -> None:
        sequence, utime = sequence_of(message), utime_of(message)
        if not self.messages:
            self.first = sequence
        self.messages += 1
        self.message_bytes += len(message)
        self.ages[_bucket(now_us - utime)] += 1
        if self.newest is not None:
            self.longest_silence_us = max(self.longest_silence_us, now_us - self.received_us)
            self.ages_before[_bucket(now_us - self.newest_utime)] += 1
            self.not_newer += sequence <= self.newest
            self.missing += max(0, sequence - self.newest - 1)
        self.newest, self.newest_utime, self.received_us = sequence, utime, now_us

    def report(self) -> dict[str, Any]:
        return {
            "messages": self.messages,
            "message_bytes": self.message_bytes,
            "first": self.first,
            "newest": self.newest,
            "missing": self.missing,
            "not_newer": self.not_newer,
            "longest_silence_us": self.longest_silence_us,
            "ages_us": _histogram(self.ages),
            "ages_before_us": _histogram(self.ages_before),
        }


def _bucket(us: int) -> int:
    return math.ceil(math.log2(max(us, 1)) * _BUCKETS_PER_OCTAVE)


def _histogram(buckets: Counter[int]) -> list[tuple[int, int]]:
    return [(round(2 ** (bucket / _BUCKETS_PER_OCTAVE)), count) for bucket, count in sorted(buckets.items())]


class _Session:
    """One session with its subscribers."""

    def __init__(self, config: str, keys: list[str]) -> None:
        self._lock = threading.Lock()
        self._streams: dict[str, _Stream] = {}
        self._session = zenoh.open(zenoh.Config.from_json5(config))
        for key in keys:
            self._session.declare_subscriber(key, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        now_us = time.time_ns() // 1000
        message, key = sample.payload.to_bytes(), str(sample.key_expr)
        if len(message) >= CONTENT_OFFSET and not key.endswith("/parameters"):
            with self._lock:
                self._streams.setdefault(key, _Stream()).record(now_us, message)

    def report(self, *, take: bool) -> dict[str, dict[str, Any]]:
        with self._lock:
            reports = {key: stream.report() for key, stream in self._streams.items()}
            if take:
                self._streams = {
                    key: _Stream(
                        newest=stream.newest,
                        newest_utime=stream.newest_utime,
                        received_us=stream.received_us,
                    )
                    for key, stream in self._streams.items()
                }
        return reports

    def close(self) -> None:
        self._session.close()


def main(config: str, count: str, *keys: str) -> None:
    """Subscribe until the end of the input."""
    sessions = [_Session(config, list(keys)) for _ in range(int(count))]
    for line in sys.stdin:
        reports = [session.report(take=line.strip() == "take") for session in sessions]
        print(json.dumps(reports), flush=True)
    for session in sessions:
        session.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
