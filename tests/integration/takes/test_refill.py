"""What a subscriber misses while it is stopped or cut off comes from the gateway's history."""

import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest
import zenoh

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.reception import Messages
from gateway.messages.decode import prefix_of
from tests.integration.takes.test_record import Ended, Lab, assert_same_bytes, lab, num_recorded, recording
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns

MARKERS: Final = "MOCAP_LAB_1_3D"


def refilled(ended: Ended) -> int:
    """Return how many messages with markers were refilled, according to the table."""
    match = re.search(r"^Lab-1 +3d .* Hz +(\S+) +\S+ +\S+$", ended.stdout, re.MULTILINE)
    assert match is not None, ended
    return 0 if match[1] == "-" else int(match[1])


def wait_for_frames(gateway: Lab, number: int) -> None:
    """Wait until the gateway has published so many more frames."""
    until = len(gateway.published[MARKERS]) + number
    wait_until(lambda: len(gateway.published[MARKERS]) >= until)


def record_past(path: Path, gateway: Lab, options: tuple[str, ...], disturb: Callable[[int], None]) -> Ended:
    """Record some frames, ``disturb`` the process with this id, and record what follows."""
    with recording(path, *options) as record:
        wait_until(lambda: num_recorded(path, MARKERS) > 20)
        wait_until(
            lambda: num_recorded(path, "MOCAP_LAB_1_CLOCK") > 0
        )  # the last of what comes once a second
        disturb(record.process.pid)
        newest = gateway.published[MARKERS][-1]
        wait_until(lambda: newest in path.read_bytes())
        return record.end()


@contextmanager
def stoppable_router(endpoint: str) -> Iterator[list[zenoh.Session]]:
    """Run a router; a test may close it and put another one into the list."""
    routers = [open_zenoh("router", listen=endpoint)]
    try:
        yield routers
    finally:
        routers[-1].close()


@pytest.mark.parametrize("history_s", [60.0, 0.5])
def test_a_restart_of_the_router_costs_nothing_that_the_history_has(tmp_path: Path, history_s: float) -> None:
    """Gateway and recorder find the router again by themselves; what is too old by then is named."""
    path, endpoint = tmp_path / "walk.lcmlog", free_endpoint()
    with (
        stoppable_router(endpoint) as routers,
        lab(tmp_path, router=endpoint, history_s=history_s) as gateway,
    ):

        def restart(_: int) -> None:
            routers[-1].close()
            wait_for_frames(gateway, 400)
            routers.append(open_zenoh("router", listen=endpoint))
            wait_for_frames(gateway, 100)

        ended = record_past(path, gateway, ("--connect", endpoint), restart)
        if history_s > 10:
            assert_same_bytes(path, gateway.published)
    if history_s > 10:
        assert ended.status == 0, ended
        assert ended.stdout.endswith("complete: no gaps\n")
        assert refilled(ended) > 200
    else:
        assert ended.status == 1
        assert re.search(r"^Lab-1 3d: the messages \d+ to \d+ are missing$", ended.stdout, re.MULTILINE), (
            ended
        )


def test_a_recorder_on_lcm_that_stands_still_loses_nothing(tmp_path: Path) -> None:
    """The kernel's buffer is full after a moment; poses of tools have labels that channels do not say."""
    path = tmp_path / "walk.lcmlog"
    with lab(tmp_path, "lcm") as gateway:
        url = f"{gateway.options[-1]}&recv_buf_size=60000"

        def stop(process_id: int) -> None:
            os.kill(process_id, signal.SIGSTOP)
            wait_for_frames(gateway, 200)
            os.kill(process_id, signal.SIGCONT)
            wait_for_frames(gateway, 50)

        ended = record_past(path, gateway, ("--lcm", "--url", url), stop)
        assert_same_bytes(path, gateway.published)
    assert ended.status == 0, ended
    assert refilled(ended) > 50


@pytest.mark.parametrize("side", ["zenoh", "lcm"])
def test_a_late_joiner_gets_the_last_seconds_and_then_what_is_live(tmp_path: Path, side: str) -> None:
    received: list[int] = []

    def receive(_source: str, key: str, message: bytes) -> None:
        if key == "3d":
            received.append(prefix_of(message).sequence)

    with lab(tmp_path, side) as gateway:
        wait_for_frames(gateway, 200)
        newest = prefix_of(gateway.published[MARKERS][-1]).sequence
        where = gateway.options[-1]
        address = GatewayAddress(is_lcm=side == "lcm", connect=where, url=where)
        with GatewayClient(address) as client:
            subscriber = client.subscribe(["Lab-1"], ["3d"], Messages(receive), complete=True, last_s=60)
            try:
                wait_until(lambda: received and received[-1] > newest + 100)
            finally:
                subscriber.close()
    assert received == [*range(received[0], received[0] + len(received))]
    assert received[0] == 0
