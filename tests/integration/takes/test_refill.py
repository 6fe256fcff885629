"""What a subscriber misses while it is stopped or cut off comes from the gateway's history."""

import os
import signal
from contextlib import ExitStack
from pathlib import Path

import pytest

from gateway.client.request_timing import PATIENCE_S
from gateway.messages.history import sequence_of
from tests.support.networks import free_endpoint, open_zenoh
from tests.support.record_process import (
    MARKERS,
    assert_same_bytes,
    by_channel,
    is_recorded,
    lab,
    num_recorded,
    record_past,
    recording,
    refilled,
    stoppable_router,
    wait_for_frames,
    wait_until_it_hears_everything,
)
from tests.support.waiting import wait_until

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


CLOCK = "MOCAP_LAB_1_CLOCK"
GIVEN_UP_CLOCKS = 10
"""One comes a second. If messages arrive and nobody takes the requests, these end after 3 s."""

MAX_WAIT_S = PATIENCE_S + 60.0
"""On a busy computer, answers of the history can be lost until the recorder has no more patience."""

TRIAL = (MARKERS, *(f"MOCAP_LAB_1_{name}" for name in ("6D", "ANALOG", "FORCE", "6D_TOOL_1", "6D_TOOL_2")))


@pytest.mark.parametrize(
    ("side", "waits"),
    [("zenoh", True), ("zenoh", False), ("lcm", True)],
    ids=["zenoh, has caught up", "zenoh, ends at once", "lcm, has caught up"],
)
def test_a_short_trial_after_a_restart_of_the_gateway_is_not_lacking_unsaid(
    tmp_path: Path, side: str, *, waits: bool
) -> None:
    """Little or nothing arrives live: the recorder stands still until the server has ended."""
    path = tmp_path / "walk.lcmlog"
    with ExitStack() as stack:
        gateway = stack.enter_context(lab(tmp_path, side))
        options = gateway.options
        if side == "lcm":
            options = (*options[:-1], f"{options[-1]}&recv_buf_size=60000")
        record = stack.enter_context(recording(path, *options))
        wait_until_it_hears_everything(path)
        os.kill(record.process.pid, signal.SIGSTOP)
        gateway.restart()
        wait_until(lambda: has_begun_again(gateway.published[MARKERS]))
        wait_for_frames(gateway, 200)
        gateway.server.kill()
        os.kill(record.process.pid, signal.SIGCONT)
        if waits:
            for channel in TRIAL:
                wait_until_caught_up(path, gateway.published[channel][-1])
        ended = record.end(signal.SIGTERM)
    assert ended.status == 1, ended  # what the first gateway published last went with it
    assert "INCOMPLETE" in ended.stdout
    if waits:
        recorded = by_channel(path)
        for channel in TRIAL:
            trial = last_run(recorded[channel])
            if "were lost" in ended.stdout:
                assert side == "lcm"  # a busy machine loses datagrams, and says so
                continue
            assert [sequence_of(message) for message in trial] == list(range(len(trial))), channel
            published = last_run(gateway.published[channel])
            assert trial[-len(published) :] == published, channel


def wait_until_caught_up(path: Path, message: bytes) -> None:
    """Wait until a message is recorded, or long enough after it that a busy recorder has given it up."""
    num_clocks = num_recorded(path, CLOCK) + GIVEN_UP_CLOCKS
    wait_until(lambda: is_recorded(path, message) or num_recorded(path, CLOCK) >= num_clocks, MAX_WAIT_S)


def has_begun_again(messages: list[bytes]) -> bool:
    """Whether the numbers of messages went back."""
    return len(last_run(messages)) < len(messages)


def last_run(messages: list[bytes]) -> list[bytes]:
    """Return the messages since the numbers went back last."""
    numbers = [sequence_of(message) for message in messages]
    starts = [index for index in range(1, len(numbers)) if numbers[index] < numbers[index - 1]]
    return messages[starts[-1] if starts else 0 :]
