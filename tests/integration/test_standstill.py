"""Stops of the gateway's process: what waits in the sockets is read, and the server is not blamed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Final

import pytest

from tests.gateway_process import GatewayProcess, gaps, gateway_process, simulator
from tests.waiting import wait_until

ROUNDS: Final = 5

WAITER: Final = """
import asyncio, contextlib, os, uvloop
from gateway.stream.running_time import running_timeout

async def wait_for_bytes():
    loop = asyncio.get_running_loop()
    while True:
        answer = loop.create_future()
        loop.add_reader(0, lambda: answer.done() or answer.set_result(os.read(0, 1)))
        try:
            async with running_timeout(0.1):  # less than a stop counts at most
                print("read", await answer, flush=True)
        except TimeoutError:
            with contextlib.suppress(BlockingIOError):
                print("too late:", os.read(0, 1), flush=True)

os.set_blocking(0, False)
print("ready", flush=True)
uvloop.run(wait_for_bytes())
"""


def test_what_arrives_during_a_stop_is_read_before_a_timeout_ends() -> None:
    """After a stop, the event loop calls its timers before it reads the sockets."""
    with subprocess.Popen(
        [sys.executable, "-c", WAITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=0
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for number in range(ROUNDS):
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED)
            os.write(process.stdin.fileno(), b"%d" % number)
            time.sleep(0.3)  # the length of the stop, three times the time-out
            process.send_signal(signal.SIGCONT)
            assert process.stdout.readline() == f"read b'{number}'\n"
        process.kill()


STALL_S: Final = 1.2
"""The gateway's limit of silence. The long stops exceed it."""

ALL_200: Final = ("--rate", "200", "--analog-rate", "200")
DENSE_1000: Final = ("--rate", "1000", "--analog-rate", "1000", "--markers", "50")


def lost_causes(gateway: GatewayProcess) -> set[str]:
    return {loss.cause for loss in gateway.statuses[-1].streams[0].drops}


def assert_nothing_is_lost(gateway: GatewayProcess, simulator_log: Path) -> None:
    assert set(gateway.headers) == {"3d", "6d", "analog", "force", "event"}
    for component in ("3d", "6d", "analog", "force"):
        headers = gateway.headers[component]
        if gaps([header.frame_number for header in headers]):
            # On a busy computer, the simulator leaves out frames for which it is a second too late itself.
            wait_until(lambda: lost_causes(gateway) == {"not sent by the server"})
        assert gaps([header.sequence for header in headers]) == [], component
        assert {header.session for header in headers} == {1}, component
    assert lost_causes(gateway) <= {"not sent by the server"}
    assert "does not read" not in simulator_log.read_text()
    events = [header.sequence for header in gateway.headers["event"]]
    assert gaps(events) == []
    assert "connecting again" not in gateway.log
    assert gateway.statuses[-1].streams[0].reconnects == 0


@pytest.mark.parametrize(
    ("scene", "rate_hz", "stops_s"),
    [
        pytest.param(ALL_200, 200, (0.3, 2.0), id="200 Hz"),
        pytest.param(DENSE_1000, 1000, (0.3, 3.0), id="1000 Hz"),
    ],
)
def test_stops_of_the_gateway_lose_nothing(
    tmp_path: Path, scene: tuple[str, ...], rate_hz: int, stops_s: tuple[float, ...]
) -> None:
    log = tmp_path / "simulator.log"
    with (
        simulator(*scene, log=log) as (port, _),
        gateway_process(tmp_path, port, stall_timeout_s=STALL_S) as gateway,
    ):
        gateway.wait_for_clock()
        gateway.wait_for_frames(rate_hz // 4)
        for stop_s in stops_s:
            gateway.stop_for(stop_s)
            gateway.wait_for_frames(round(rate_hz * (stop_s + 1)))
        assert_nothing_is_lost(gateway, log)


def test_a_stop_of_gateway_and_server_together_keeps_the_connection(tmp_path: Path) -> None:
    """As when a computer with both, or a virtual machine, stands still: nothing waits in the socket then."""
    with (
        simulator(*ALL_200) as (port, server),
        gateway_process(tmp_path, port, stall_timeout_s=STALL_S) as gateway,
    ):
        gateway.wait_for_clock()
        server.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, server.pid, os.WSTOPPED)
        gateway.stop_for(2.0)
        time.sleep(0.5)  # the server continues after the gateway
        server.send_signal(signal.SIGCONT)
        gateway.wait_for_frames(200)
        assert {header.session for header in gateway.headers["3d"]} == {1}
        assert "connecting again" not in gateway.log
