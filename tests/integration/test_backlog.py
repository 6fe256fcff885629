"""The gateway's process is stopped for a while: with default settings, no subscriber loses a message."""

import contextlib
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import lcm
import pytest
import yaml
import zenoh

from tests.networks import free_endpoint, lcm_url, open_zenoh, zenoh_keys
from tests.waiting import wait_until

pytestmark = pytest.mark.netns

PROGRAM: Final = (sys.executable, "-m", "gateway")
COMPONENTS: Final = {"3d", "6d", "analog", "force", "event"}
_SEQUENCE: Final = struct.Struct(">q")
_SEQUENCE_OFFSET: Final = 24

NUM_TRIES: Final = 4

DENSE: Final = ("--markers", "100", "--tools", "10", "--analog", "32")


class Received:
    """The sequence numbers that one subscriber received, by component."""

    def __init__(self) -> None:
        self.sequences: defaultdict[str, list[int]] = defaultdict(list)

    def add(self, component: str, message: bytes) -> None:
        if component in COMPONENTS:
            self.sequences[component].append(*_SEQUENCE.unpack_from(message, _SEQUENCE_OFFSET))

    @property
    def frames(self) -> int:
        return len(self.sequences["3d"])

    @property
    def num_missing(self) -> int:
        return sum(self.missing.values())

    @property
    def missing(self) -> dict[str, int]:
        """How many messages of each component are missing between the first and the last."""
        return {
            component: sequences[-1] - sequences[0] + 1 - len(set(sequences))
            for component, sequences in list(self.sequences.items())
        }


@contextlib.contextmanager
def subscribed_on_lcm(url: str) -> Iterator[Received]:
    """Subscribe with the kernel's default receive buffer."""
    received = Received()
    connection = lcm.LCM(url)
    subscription = connection.subscribe(
        "MOCAP_LAB_.*", lambda channel, message: received.add(channel.rpartition("_")[2].lower(), message)
    )
    subscription.set_queue_capacity(10_000)  # this process may have to wait for a core
    ended = threading.Event()

    def receive() -> None:
        while not ended.is_set():
            connection.handle_timeout(50)

    thread = threading.Thread(target=receive)
    thread.start()
    try:
        yield received
    finally:
        ended.set()
        thread.join()


@contextlib.contextmanager
def subscribed_on_zenoh(endpoint: str) -> Iterator[Received]:
    received = Received()

    def receive(sample: zenoh.Sample) -> None:
        received.add(str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes())

    session = open_zenoh("peer", listen=endpoint)
    session.declare_subscriber("mocap/lab/*", receive)
    try:
        yield received
    finally:
        session.close()


@contextlib.contextmanager
def program(*arguments: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen([*PROGRAM, *arguments], text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("scene", "rate_hz", "stops_s"),
    [
        pytest.param((), 200, (2.0,), id="lab"),
        pytest.param(DENSE, 500, (0.3, 1.0), id="dense"),
    ],
)
def test_stops_of_the_gateway_lose_nothing(
    tmp_path: Path, scene: tuple[str, ...], rate_hz: int, stops_s: tuple[float, ...]
) -> None:
    url, endpoint = lcm_url(), free_endpoint()
    with contextlib.ExitStack() as stack:
        on_lcm = stack.enter_context(subscribed_on_lcm(url))
        on_zenoh = stack.enter_context(subscribed_on_zenoh(endpoint))
        server = stack.enter_context(
            program(
                *("simulate", "--port", "0", "--rate", str(rate_hz), "--analog-rate", str(rate_hz), *scene),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        )
        assert server.stdout is not None
        port = int(server.stdout.readline().partition(";")[0].rpartition(":")[2])
        configuration = {
            "sources": [{"name": "lab", "host": "127.0.0.1", "port": port}],
            "zenoh": {"config": zenoh_keys("peer", connect=endpoint)},
            "lcm": {"enabled": True, "url": url},
            "metrics": {"enabled": False},
        }
        (tmp_path / "gateway.yaml").write_text(yaml.safe_dump(configuration))
        gateway = stack.enter_context(program("run", "--config", str(tmp_path / "gateway.yaml")))

        def has_frames(count: float) -> bool:
            return min(on_lcm.frames, on_zenoh.frames) > count

        wait_until(partial(has_frames, 2 * rate_hz))  # the pace needs a clock, which takes 1.5 s
        for stop_s in stops_s:
            # A subscriber on LCM also loses messages if a busy computer does not run it in time.
            for _ in range(NUM_TRIES):
                missing_before = on_lcm.num_missing
                # Until the backlog is published, and some frames more.
                after = on_zenoh.frames + rate_hz * (2 * stop_s + 1)
                gateway.send_signal(signal.SIGSTOP)
                os.waitid(os.P_PID, gateway.pid, os.WSTOPPED)
                time.sleep(stop_s)
                gateway.send_signal(signal.SIGCONT)
                wait_until(partial(has_frames, after))
                if on_lcm.num_missing == missing_before:
                    break
            else:
                pytest.fail(f"on LCM, each stop of {stop_s} s costs messages: {on_lcm.missing}")
        assert set(on_zenoh.missing.values()) == {0}
        assert set(on_zenoh.sequences) == set(on_lcm.sequences) == COMPONENTS
