"""Stop a gateway under load many times: every stop must end with status 0 within 2 s.

    tests/with-netns .venv/bin/python -m tests.stops --count 500

The load: 500 frames per second with all components, a Zenoh subscriber to everything, a Zenoh peer that
queries all keys without a pause, an LCM subscriber, and an LCM program that sends requests without a pause.
Each gateway stops at a random moment after frames have arrived, every third one with SIGINT.
"""

import argparse
import contextlib
import itertools
import json
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from tests.support.configurations import write_config
from tests.support.gateway_process import PROGRAM, simulator
from tests.support.networks import free_endpoint, lcm_url, zenoh_keys

MAX_STOP_S: Final = 2.0
_START_TIMEOUT_S: Final = 60.0
_KILL_S: Final = 20.0

_LOAD: Final = """
import json, sys, threading, time
import lcm, rtc3d, zenoh
keys, url, queries_url = json.loads(sys.argv[1])
num_frames = 0
def on_sample(sample):
    global num_frames
    num_frames += str(sample.key_expr).endswith("/3d")
def ask():
    while True:
        for _ in session.get("mocap/lab/**", timeout=1):
            pass
        time.sleep(0.005)
def request():
    message = rtc3d.parameters_request_t()
    message.requester = "stops"
    sender = lcm.LCM(queries_url)
    while True:
        message.request_id += 1
        sender.publish("MOCAP_LAB_PARAMETERS_REQUEST", message.encode())
        time.sleep(0.002)
def listen():
    receiver = lcm.LCM(url)
    receiver.subscribe("MOCAP_.*", lambda channel, data: None)
    while True:
        receiver.handle_timeout(100)
session = zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))
session.declare_subscriber("mocap/**", on_sample)
for work in (ask, request, listen):
    threading.Thread(target=work, daemon=True).start()
for line in sys.stdin:
    print(num_frames, flush=True)
"""


class Stop(NamedTuple):
    """One stop: the exit status, how long it took in s, and the end of the log if it went wrong."""

    status: int
    seconds: float
    log: str

    @property
    def is_good(self) -> bool:
        return self.status == 0 and self.seconds <= MAX_STOP_S


class Load:
    """The peers of the gateways, in a process of their own."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def num_frames(self) -> int:
        """Return how many frames have arrived on Zenoh."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())

    def wait_for_frames(self, process: subprocess.Popen[bytes]) -> None:
        before = self.num_frames()
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while self.num_frames() < before + 20:
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise RuntimeError(f"the gateway sends no frames (status {process.returncode})")
            time.sleep(0.01)


def run_stops(count: int, folder: Path) -> Iterator[Stop]:
    """Start and stop ``count`` gateways one after the other."""
    endpoint, url, queries_url = free_endpoint(), lcm_url(), lcm_url()
    scene = ("--rate", "500", "--analog-rate", "500", "--markers", "30")
    peer = json.dumps([zenoh_keys("peer", connect=endpoint), url, queries_url])
    with contextlib.ExitStack() as stack:
        port, _ = stack.enter_context(simulator(*scene))
        load_process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", _LOAD, peer], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        )
        stack.callback(load_process.kill)
        load = Load(load_process)
        config = write_config(
            folder / "gateway.yaml",
            port,
            zenoh={"config": zenoh_keys("peer", listen=endpoint), "tool_poses": True},
            lcm={"url": url, "queries_url": queries_url},
        )
        signals = itertools.cycle((signal.SIGTERM, signal.SIGTERM, signal.SIGINT))
        for number in itertools.islice(signals, count):
            yield _stop(load, config, folder / "gateway.log", number)


def _stop(load: Load, config: Path, log: Path, number: signal.Signals) -> Stop:
    with (
        log.open("wb") as file,
        subprocess.Popen([*PROGRAM, "run", "--config", str(config)], stderr=file) as process,
    ):
        try:
            load.wait_for_frames(process)
            time.sleep(random.uniform(0, 0.3))
            began_s = time.monotonic()
            process.send_signal(number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_KILL_S)
            seconds = time.monotonic() - began_s
        finally:
            process.kill()
    return Stop(process.returncode, seconds, log.read_text()[-3000:])


def report(stops: Sequence[Stop]) -> str:
    """Return how long the stops took, and their exit statuses."""
    seconds = sorted(stop.seconds for stop in stops)
    statuses = ", ".join(
        f"{count} with status {status}" for status, count in sorted(_statuses(stops).items())
    )
    at_deadline = sum("ends at once" in stop.log for stop in stops)
    return (
        f"{len(stops)} stops: {statuses}; median {statistics.median(seconds):.2f} s, "
        f"99 % within {seconds[int(0.99 * (len(seconds) - 1))]:.2f} s, longest {seconds[-1]:.2f} s; "
        f"{at_deadline} at the deadline"
    )


def _statuses(stops: Sequence[Stop]) -> Counter[int]:
    return Counter(stop.status for stop in stops)


def main() -> None:
    """Run the stops; exit with status 1 if one was bad."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=500, help="how many stops")
    count = parser.parse_args().count
    stops: list[Stop] = []
    with tempfile.TemporaryDirectory() as folder:
        for stop in run_stops(count, Path(folder)):
            stops.append(stop)
            if not stop.is_good:
                print(f"stop {len(stops)}: status {stop.status} after {stop.seconds:.2f} s\n{stop.log}")
            if len(stops) % 50 == 0:
                print(report(stops), flush=True)
    print(report(stops))
    sys.exit(any(not stop.is_good for stop in stops))


if __name__ == "__main__":
    main()
