"""Record when the messages of one source arrive on Zenoh and LCM, in a process of its own.

    python -m tests.hostile.recorder SOURCE ZENOH_ENDPOINT LCM_URL

It prints a line once frames arrive on both outputs. For each line on stdin, it prints a line of JSON about
the time since the previous one (``Arrivals.report``), and it ends with stdin. It does little per message,
and nothing here grows with time, so it can run for hours.
"""

import contextlib
import json
import selectors
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import lcm
import zenoh

from gateway.outputs.lcm.connection import QUEUE_MESSAGES, open_lcm, receiving_url
from tests.support.networks import wait_for_zenoh

FRAME_COMPONENTS: Final = ("3d", "6d", "analog", "force")
"""The components that every frame of the healthy source has; events are rare."""

_COMPONENTS: Final = (*FRAME_COMPONENTS, "event")
_HEADER: Final = struct.Struct(
    ">24xqi4xi"
)  # fingerprint, both times; sequence, session, version, frame number
_TICK_S: Final = 0.01


class Arrivals:
    """The messages of one component on one output."""

    def __init__(self) -> None:
        self._arrival_s = 0.0
        self._sequence = 0
        self._frame_number = 0
        self._session = 0
        self._clear()

    def _clear(self) -> None:
        self.received = 0
        self._longest_silence_s = 0.0
        self._missing_messages = 0
        self._missing_frames = 0
        self._repeated = 0
        self._reconnects = 0

    def receive(self, message: bytes) -> None:
        """Note a message."""
        now_s = time.monotonic()
        sequence, session, frame_number = _HEADER.unpack_from(message)
        if self._arrival_s:
            self._longest_silence_s = max(self._longest_silence_s, now_s - self._arrival_s)
            self._missing_messages += max(0, sequence - self._sequence - 1)
            self._missing_frames += max(0, frame_number - self._frame_number - 1)
            self._repeated += sequence <= self._sequence
            self._reconnects += session != self._session
        self.received += 1
        self._arrival_s = now_s
        self._sequence = sequence
        self._frame_number = frame_number
        self._session = session

    def report(self) -> dict[str, float]:
        """Return what was noted since the last report. A silence that goes on is in both reports."""
        report = {
            "received": self.received,
            "longest_silence_s": max(self._longest_silence_s, time.monotonic() - self._arrival_s),
            "missing_messages": self._missing_messages,
            "missing_frames": self._missing_frames,
            "repeated": self._repeated,
            "reconnects": self._reconnects,
        }
        self._clear()
        return report


class Outputs:
    """The arrivals by output and component."""

    def __init__(self) -> None:
        self._arrivals = {
            output: {component: Arrivals() for component in _COMPONENTS} for output in ("zenoh", "lcm")
        }
        self._pause_s = 0.0
        self._dropped = 0
        threading.Thread(target=self._watch_own_pauses, daemon=True).start()

    def _watch_own_pauses(self) -> None:
        before_s = time.monotonic()
        while True:
            time.sleep(_TICK_S)
            now_s = time.monotonic()
            self._pause_s = max(self._pause_s, now_s - before_s - _TICK_S)
            before_s = now_s

    def receive_sample(self, sample: zenoh.Sample) -> None:
        self._receive("zenoh", str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes())

    def receive_lcm(self, channel: str, message: bytes) -> None:
        self._receive("lcm", channel.rpartition("_")[2].lower(), message)

    def _receive(self, output: str, component: str, message: bytes) -> None:
        arrivals = self._arrivals[output].get(component)  # None for the status, the clock, the parameters
        if arrivals is not None:
            arrivals.receive(message)

    def have_frames(self) -> bool:
        """Return whether each component of frames has arrived on each output."""
        return all(
            components[component].received
            for components in self._arrivals.values()
            for component in FRAME_COMPONENTS
        )

    def report(self) -> dict[str, Any]:
        """Return the reports by output and component, and what this process itself suffered.

        That is its longest pause, in s, and how many datagrams of LCM it did not read in time.
        """
        reports: dict[str, Any] = {
            output: {component: arrivals.report() for component, arrivals in components.items()}
            for output, components in self._arrivals.items()
        }
        reports["recorder_pause_s"], self._pause_s = self._pause_s, 0.0
        dropped_before, self._dropped = self._dropped, _dropped_datagrams()
        reports["recorder_dropped"] = self._dropped - dropped_before
        return reports


def _dropped_datagrams() -> int:
    """Return how many datagrams the kernel has dropped that this process did not read in time."""
    mine = set()
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the one that lists the folder
            mine.add(str(file.readlink()).removeprefix("socket:[").removesuffix("]"))
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if row[9] in mine)


def _serve(outputs: Outputs, messages: lcm.LCM) -> None:
    """Handle the messages of LCM and the lines on stdin."""
    selector = selectors.DefaultSelector()
    selector.register(messages.fileno(), selectors.EVENT_READ, messages.handle)
    selector.register(sys.stdin, selectors.EVENT_READ)
    is_ready = False
    while True:
        for key, _ in selector.select():
            if key.data is not None:
                key.data()
            elif sys.stdin.readline():
                print(json.dumps(outputs.report()), flush=True)
            else:
                return
        if not is_ready and outputs.have_frames():
            is_ready = True
            outputs.report()  # what came before the other output was there
            print("frames arrive", flush=True)


def main() -> None:
    source, endpoint, url = sys.argv[1:]
    outputs = Outputs()
    messages = open_lcm(receiving_url(url))
    subscription = messages.subscribe(f"MOCAP_{source.upper()}_.*", outputs.receive_lcm)
    subscription.set_queue_capacity(QUEUE_MESSAGES)
    session = wait_for_zenoh(endpoint)
    session.declare_subscriber(f"mocap/{source}/*", outputs.receive_sample)
    _serve(outputs, messages)
    session.close()


if __name__ == "__main__":
    main()
