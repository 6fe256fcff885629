"""Stops of the gateway's process: nothing is lost by default, or what is skipped is counted."""

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import pytest

from gateway.messages.decode import decode
from gateway.outputs.lcm.receiver import joined_socket, split_datagram
from gateway.session.status import NOT_SENT, SKIPPED
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.support.errors import names
from tests.support.gateway_process import GatewayProcess, gaps, gateway_process, simulator
from tests.support.networks import lcm_url
from tests.support.waiting import wait_until, wait_until_async

ROUNDS: Final = 3

WAITER: Final = """
import asyncio, contextlib, os, uvloop
from gateway.session.process_clock import RunningTimeout

async def wait_for_bytes():
    loop = asyncio.get_running_loop()
    while True:
        answer = loop.create_future()
        loop.add_reader(0, lambda: answer.done() or answer.set_result(os.read(0, 1)))
        try:
            async with RunningTimeout(0.1):  # less than a stop counts at most
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


COMPONENTS: Final = {"3d", "6d", "analog", "force", "event"}
NUM_TRIES: Final = 4
LAB: Final = ("--rate", "200", "--analog-rate", "200")
DENSE: Final = (
    *("--rate", "500", "--analog-rate", "500"),
    *("--markers", "100", "--tools", "10", "--analog", "32"),
)


_SO_RCVBUFFORCE: Final = 33  # of Linux; Python's socket module does not have it


class LcmSequences:
    """The sequence numbers by component that a subscriber gets, however late a busy computer runs it.

    In the receive buffer that the kernel gives to any program, 40 ms of the dense scene find room. If the
    test may not have a larger one, messages can be lost that the gateway has sent.
    """

    def __init__(self, url: str) -> None:
        self.numbers: defaultdict[str, list[int]] = defaultdict(list)
        self.statuses: list[Any] = []
        self._socket = joined_socket(url)
        self._socket.settimeout(0.1)
        with contextlib.suppress(PermissionError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 32 * 1024 * 1024)
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._receive)
        self._thread.start()

    def _receive(self) -> None:
        while not self._is_closed.is_set():
            with contextlib.suppress(TimeoutError):
                self._add(*split_datagram(self._socket.recv(65_535)))

    def _add(self, channel: str, message: bytes) -> None:
        component = channel.rpartition("_")[2].lower()
        if component in COMPONENTS:
            self.numbers[component].append(int.from_bytes(message[24:32], "big"))
        elif component == "status":
            self.statuses.append(decode(message))

    @property
    def num_missing(self) -> int:
        """How many messages are missing between the first and the last of each component."""
        return sum(each[-1] - each[0] + 1 - len(set(each)) for each in list(self.numbers.values()))

    def close(self) -> None:
        self._is_closed.set()
        self._thread.join()
        self._socket.close()


def lost_causes(gateway: GatewayProcess) -> set[str]:
    return {loss.cause for loss in gateway.statuses[-1].streams[0].drops}


def assert_nothing_is_lost(gateway: GatewayProcess, simulator_log: Path) -> None:
    assert set(gateway.headers) == COMPONENTS
    for component, headers in gateway.headers.items():
        if component != "event" and gaps([header.frame_number for header in headers]):
            # On a busy computer, the simulator leaves out frames for which it is a second too late itself.
            wait_until(lambda: lost_causes(gateway) == {NOT_SENT})
        assert gaps([header.sequence for header in headers]) == [], component
        assert {header.session for header in headers} == {1}, component
    assert lost_causes(gateway) <= {NOT_SENT}
    assert "does not read" not in simulator_log.read_text()
    assert "connecting again" not in gateway.log
    assert gateway.statuses[-1].streams[0].reconnects == 0


@pytest.mark.netns
@pytest.mark.parametrize(
    ("scene", "rate_hz", "stops_s"),
    [pytest.param(LAB, 200, (0.3, 2.0), id="lab"), pytest.param(DENSE, 500, (0.3, 1.0), id="dense")],
)
def test_stops_of_the_gateway_lose_nothing(
    tmp_path: Path, scene: tuple[str, ...], rate_hz: int, stops_s: tuple[float, ...]
) -> None:
    log, url = tmp_path / "simulator.log", lcm_url()
    with (
        contextlib.closing(LcmSequences(url)) as on_lcm,
        simulator(*scene, log=log) as (port, _),
        gateway_process(tmp_path, port, lcm_url=url, stall_timeout_s=STALL_S) as gateway,
    ):
        gateway.wait_for_clock()  # the pace of a backlog needs it
        gateway.wait_for_frames(rate_hz // 4)
        for stop_s in stops_s:
            # Without a large buffer, a subscriber loses messages if a busy computer does not run it in time.
            for _ in range(NUM_TRIES):
                missing_before = on_lcm.num_missing
                gateway.stop_for(stop_s)
                gateway.wait_for_frames(round(rate_hz * (2 * stop_s + 1)))
                if on_lcm.num_missing == missing_before:
                    break
            else:
                pytest.fail(f"on LCM, each stop of {stop_s} s costs messages")
        assert_nothing_is_lost(gateway, log)
        assert set(on_lcm.numbers) == COMPONENTS


def test_a_stop_of_gateway_and_server_together_keeps_the_connection(tmp_path: Path) -> None:
    """As when a computer with both, or a virtual machine, stands still: nothing waits in the socket then."""
    with (
        simulator(*LAB) as (port, server),
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


@pytest.mark.netns
async def test_skipped_frames_are_the_gaps_and_the_count_in_the_status(tmp_path: Path) -> None:
    """With ``backlog: latest``, a gateway that stood still continues with the newest frame."""
    url, stream = lcm_url(), {"components": ["all"], "backlog": "latest"}
    scene = SyntheticScene(markers=10, tools=2, analog=8, plates=1, rate_hz=200, analog_rate_hz=200)
    async with Simulator(scene) as server:
        server.stop_measurement()  # until both subscribers are there
        with (
            contextlib.closing(LcmSequences(url)) as on_lcm,
            gateway_process(tmp_path, server.port, lcm_url=url, streams=[stream]) as gateway,
        ):
            for statuses in (gateway.statuses, on_lcm.statuses):
                await wait_until_async(partial(has_state, statuses, "no measurement"))
            server.start_measurement()
            await asyncio.to_thread(gateway.wait_for_clock)
            await asyncio.to_thread(gateway.stop_for, 1.0)
            await wait_until_async(lambda: SKIPPED in lost_causes(gateway))
            server.stop_measurement()  # from here on, nothing is skipped on a busy machine either
            for statuses in (gateway.statuses, on_lcm.statuses):
                await wait_until_async(partial(has_state, statuses, "no measurement"))
            sent = server.components_sent
            on_zenoh = {key: [each.sequence for each in headers] for key, headers in gateway.headers.items()}
            drops = {drop.cause: drop for drop in gateway.statuses[-1].streams[0].drops}
            assert names(gateway.log, "backlog: latest")
    skipped = drops[SKIPPED]
    assert skipped.messages == 4 * skipped.frames > 200
    for numbers in (on_zenoh, on_lcm.numbers):
        for component, sequences in numbers.items():
            num_missing = 0 if component == "event" else skipped.frames
            assert (sequences[0], sequences) == (0, sorted(set(sequences)))
            assert sent[component] - len(sequences) == num_missing
            assert sequences[-1] + 1 - len(sequences) == num_missing


def has_state(statuses: list[Any], state: str) -> bool:
    return bool(statuses) and statuses[-1].streams[0].state == state
