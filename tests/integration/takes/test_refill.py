"""What a subscriber misses while it is stopped or cut off comes from the gateway's history."""

import os
import re
import signal
from pathlib import Path

import pytest

from gateway.client.client import GatewayAddress, GatewayClient
from gateway.client.reception import Messages
from gateway.messages.decode import prefix_of
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.record_process import (
    MARKERS,
    assert_same_bytes,
    lab,
    record_past,
    refilled,
    stoppable_router,
    wait_for_frames,
)
from tests.support.waiting import wait_until

pytestmark = pytest.mark.netns


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
