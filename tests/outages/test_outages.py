"""Long outages on a dense stream: ``record`` ends complete, with what a recorder beside it wrote.

tests/integration/takes/test_refill.py has the same in short, and what else can happen.
"""

import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import pytest

from gateway.messages.history import sequence_of
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.record_process import (
    COMPONENTS,
    MARKERS,
    Lab,
    by_channel,
    lab,
    recording,
    refilled,
    stoppable_router,
    wait_for_frames,
    wait_until_it_hears_everything,
    wait_until_recorded,
)

pytestmark = pytest.mark.netns

SHARE: Final = 1.0 if os.environ.get("FULL_OUTAGES") else 0.5
"""The share of the promised rate, and of the promised length of the long outages."""

RATE_HZ: Final = round(1000 * SHARE)
DENSE: Final = (
    *("--rate", str(RATE_HZ), "--analog-rate", str(RATE_HZ)),
    *("--markers", "100", "--tools", "10", "--analog", "32"),
)
"""What the benchmarks call dense: five components in every frame."""


def assert_complete_past(
    folder: Path,
    gateway: Lab,
    options: Sequence[str],
    seconds: float,
    outage: Callable[[int, float], None],
) -> None:
    """Record with two recorders, one of which has an ``outage``, and check that both have the same messages.

    ``outage`` is called with the process id of that recorder, and how many seconds to take.
    """
    paths = [folder / name / "walk.lcmlog" for name in ("undisturbed", "disturbed")]
    for path in paths:
        path.parent.mkdir()
    with recording(paths[0], *gateway.options) as undisturbed, recording(paths[1], *options) as disturbed:
        for path in paths:
            wait_until_it_hears_everything(path)
        outage(disturbed.process.pid, seconds)
        wait_for_frames(gateway, 100)
        wait_until_recorded(paths[1], gateway.published[MARKERS][-1])
        ends = [disturbed.end(), undisturbed.end()]
    for ended in ends:
        assert ended.status == 0, ended
    assert refilled(ends[0]) > 0  # the rest waits in buffers
    expected, recorded = map(by_channel, paths)
    for name in (*COMPONENTS, "status", "clock"):
        channel = f"MOCAP_LAB_1_{name.upper()}"
        first = max(sequence_of(each[channel][0]) for each in (expected, recorded))
        last = min(sequence_of(each[channel][-1]) for each in (expected, recorded))
        common = [
            [message for message in each[channel] if first <= sequence_of(message) <= last]
            for each in (expected, recorded)
        ]
        assert [*map(sequence_of, common[0])] == [*range(first, last + 1)], name
        assert common[0] == common[1], name


@pytest.mark.parametrize(("side", "seconds"), [("zenoh", 10.0 * SHARE), ("lcm", 3.0)])
def test_a_recorder_that_is_stopped(tmp_path: Path, side: str, seconds: float) -> None:
    """On LCM, the kernel's default buffer is full after some hundredths of a second."""

    def stop(process_id: int, seconds: float) -> None:
        os.kill(process_id, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(process_id, signal.SIGCONT)

    with lab(tmp_path, side, *DENSE, has_tool_poses=False) as gateway:
        assert_complete_past(tmp_path, gateway, gateway.options, seconds, stop)


def test_a_recorder_whose_router_restarts(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with (
        stoppable_router(endpoint) as routers,
        lab(tmp_path, "zenoh", *DENSE, router=endpoint, has_tool_poses=False) as gateway,
    ):

        def restart(_: int, seconds: float) -> None:
            routers[-1].close()
            time.sleep(seconds)
            routers.append(open_zenoh("router", listen=endpoint))

        assert_complete_past(tmp_path, gateway, ("--connect", endpoint), 20.0 * SHARE, restart)
