"""Join the markers and the analog channels of one source, which have different rates, by their time stamps.

    pip install eclipse-zenoh numpy
    python examples/join.py [--connect tcp/192.0.2.5:7447] [--source lab] [--count N]

For each frame of markers, it prints the analog samples that were taken since the frame before.
docs/how-to/join-components.md explains why it uses ``timestamp``, not ``frame_number``.
"""

import argparse
import contextlib
import itertools
import json
import queue
import struct
import sys
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import zenoh

MAX_FRAMES = 1000  # of markers that wait for analog samples: 5 s at 200 Hz
MAX_SAMPLES = 20_000  # analog samples that wait for a frame of markers: 10 s at 2000 Hz
MARKERS, ANALOG = "3d", "analog"
TYPES = {  # the fingerprint of the messages, and one item of them
    MARKERS: ("e95d5a478ce229e4", np.dtype([(name, ">f4") for name in ("x", "y", "z", "reliability")])),
    ANALOG: ("cd43a9dd46669bec", np.dtype(">f4")),
}


class Timed(NamedTuple):
    """A frame of markers, or one sample of all analog channels."""

    timestamp_us: int
    frame_number: int
    items: Any


class Join:
    """Pairs each frame of markers with the analog samples since the frame before.

    The two arrive on connections of their own, and either can be ahead. A frame of markers therefore waits
    until an analog sample of the same time or a later one has arrived. Neither waits without a limit:
    if one component stops, the other does not fill the memory.
    """

    def __init__(self) -> None:
        self.num_dropped_samples = 0
        self.start_again()

    def start_again(self) -> None:
        """Forget everything, because the time stamps have started again."""
        self._frames: deque[Timed] = deque()
        self._samples: deque[Timed] = deque()
        self._newest_us: dict[str, int] = {}
        self._previous_us: int | None = None

    def add(self, component: str, timed: Timed) -> Iterator[tuple[Timed, list[Timed]]]:
        """Add a frame or a sample; yield the frames that are now complete, each with its samples."""
        if timed.timestamp_us < self._newest_us.get(component, timed.timestamp_us):
            self.start_again()
        self._newest_us[component] = timed.timestamp_us
        (self._frames if component == MARKERS else self._samples).append(timed)
        while self._frames and self._is_complete(self._frames[0]):
            frame = self._frames.popleft()
            samples = self._take_samples(frame.timestamp_us)
            if self._previous_us is not None:
                yield frame, [sample for sample in samples if sample.timestamp_us > self._previous_us]
            self._previous_us = frame.timestamp_us
        while len(self._samples) > MAX_SAMPLES:
            self._samples.popleft()
            self.num_dropped_samples += 1

    def _is_complete(self, frame: Timed) -> bool:
        return self._newest_us.get(ANALOG, -1) >= frame.timestamp_us or len(self._frames) > MAX_FRAMES

    def _take_samples(self, until_us: int) -> list[Timed]:
        samples = []
        while self._samples and self._samples[0].timestamp_us <= until_us:
            samples.append(self._samples.popleft())
        return samples


def decode(component: str, message: bytes) -> Timed:
    """Return the frame or sample in a message. Raises ValueError or struct.error."""
    fingerprint, item = TYPES[component]
    frame_number, timestamp_us, num_items = struct.unpack_from(">iqi", message, 40)
    if message[:8].hex() != fingerprint or len(message) != 56 + num_items * item.itemsize:
        raise ValueError(f"{len(message)} bytes for {num_items} items of {component}")
    return Timed(timestamp_us, frame_number, np.frombuffer(message, item, offset=56))


def print_pair(frame: Timed, samples: list[Timed]) -> None:
    in_view = np.count_nonzero(~np.isnan(frame.items["x"]))
    text = f"at {frame.timestamp_us / 1e6:.4f} s: {in_view} markers in view (frame {frame.frame_number})"
    if samples:
        numbers = f"{samples[0].frame_number} to {samples[-1].frame_number}"
        mean = np.mean([sample.items[0] if len(sample.items) else np.nan for sample in samples])
        text += f", {len(samples)} analog samples (frames {numbers}), mean of channel 1: {mean:.3f}"
    print(text)


def pairs(messages: "queue.Queue[tuple[str, bytes]]") -> Iterator[tuple[Timed, list[Timed]]]:
    """Yield each frame of markers with its analog samples, for ever."""
    join = Join()
    while True:
        component, message = messages.get()
        try:
            timed = decode(component, message)
        except (struct.error, ValueError) as error:
            print(f"ignored a malformed message: {error}", file=sys.stderr)
            continue
        yield from join.add(component, timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--connect", help="endpoint of the gateway or a router; default: find it by multicast"
    )
    parser.add_argument("--source", default="lab")
    parser.add_argument("--count", type=int, default=0, help="stop after this many frames; 0: never")
    options = parser.parse_args()
    if options.count < 0:
        parser.error("--count must not be negative")

    config = zenoh.Config()
    if options.connect:
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([options.connect]))
    # Zenoh waits while the queue is full, so even a program that is too slow does not fill the memory.
    messages: queue.Queue[tuple[str, bytes]] = queue.Queue(maxsize=10_000)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        sys.exit(f"Cannot open Zenoh; check that the gateway runs and --connect is its endpoint: {error}")
    with session:
        for component in (ANALOG, MARKERS):
            session.declare_subscriber(
                f"mocap/{options.source}/{component}",
                lambda sample, component=component: messages.put((component, sample.payload.to_bytes())),
            )
        print("listening", flush=True)
        for frame, samples in itertools.islice(pairs(messages), options.count or None):
            print_pair(frame, samples)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
