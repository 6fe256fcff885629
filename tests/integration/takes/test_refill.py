"""What a subscriber misses while it is stopped or cut off comes from the gateway's history."""

import os
import signal
from pathlib import Path

import pytest

from tests.support.networks import free_endpoint, open_zenoh
from tests.support.record_process import (
    assert_same_bytes,
    lab,
    record_past,
    refilled,
    stoppable_router,
    wait_for_frames,
)

pytestmark = pytest.mark.netns


def test_a_restart_of_the_router_costs_nothing_that_the_history_has(tmp_path: Path) -> None:
    """Gateway and recorder find the router again by themselves."""
    path, endpoint = tmp_path / "walk.lcmlog", free_endpoint()
    with stoppable_router(endpoint) as routers, lab(tmp_path, router=endpoint) as gateway:

        def restart(_: int) -> None:
            routers[-1].close()
            wait_for_frames(gateway, 400)
            routers.append(open_zenoh("router", listen=endpoint))
            wait_for_frames(gateway, 100)

        ended = record_past(path, gateway, ("--connect", endpoint), restart)
        assert_same_bytes(path, gateway.published)
    assert ended.status == 0, ended
    assert ended.stdout.endswith("complete: no gaps\n")
    assert refilled(ended) > 200


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
