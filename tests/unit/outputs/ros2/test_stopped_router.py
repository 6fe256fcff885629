"""A router of ROS 2 that does not read for a moment, as a busy computer does."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from gateway.rtc3d.components import ComponentType
from tests.networks import zenoh_keys
from tests.ros_lab import ALL, RosLab, frame_of, parameters, ros_lab, stamp
from tests.waiting import wait_until


def test_a_router_that_stops_reading_for_a_moment_loses_nothing() -> None:
    """Zenoh would drop messages without counting them if it did not wait for the router."""
    with ros_lab() as lab, stoppable_router(lab) as router:
        lab.open()
        publisher = lab.source(given=parameters(markers=10_000))
        wait_until(lambda: publisher.wants(ALL))
        router.send_signal(signal.SIGSTOP)
        large = frame_of((ComponentType.MARKERS, [(1, 2, 3, 0)] * 10_000))
        for number in range(_LARGE_FRAMES):
            publisher.publish(large, stamp(), number, ALL)
        time.sleep(0.3)  # how long it stands still; nothing depends on it
        router.send_signal(signal.SIGCONT)
        assert router.stdout is not None
        assert router.stdout.readline().split() == [str(n + 1).encode() for n in range(_LARGE_FRAMES)]


_LARGE_FRAMES = 100
"""Clouds of 200 kB: more than the buffers of the connection hold."""

_ROUTER = """
import struct, sys, zenoh

with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    subscriber = session.declare_subscriber("0/mocap/lab/markers/**")
    for _ in range(int(sys.argv[2])):
        attachment = subscriber.recv().attachment.to_bytes()
        print(struct.unpack_from("<q", attachment)[0], end=" ")
    print(flush=True)
"""
"""A router that prints the numbers of the first clouds, and ends."""


@contextmanager
def stoppable_router(lab: RosLab) -> Iterator[subprocess.Popen[bytes]]:
    """Replace the lab's router by a process that subscribes to the markers."""
    lab.cut()
    keys = json.dumps(zenoh_keys("router", listen=lab.endpoint))
    command = [sys.executable, "-c", _ROUTER, keys, str(_LARGE_FRAMES)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.kill()
