"""A stop of the process with ``backlog: latest``: what is missing, as subscribers and the status see it."""

import asyncio
import os
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from gateway.messages.decode import decode
from gateway.outputs.lcm.connection import open_lcm
from gateway.outputs.lcm.subscriber import LcmSubscriber
from gateway.simulator.simulator import Simulator
from gateway.simulator.synthetic import SyntheticScene
from tests.networks import free_endpoint, lcm_url, open_zenoh, zenoh_keys
from tests.waiting import wait_until_async

pytestmark = pytest.mark.netns

COMPONENTS: Final = ("3d", "6d", "analog", "force", "event")
STOP_S: Final = 1.0
STEADY_FRAMES: Final = 400
"""Frames before the stop: 2 s, in which the gateway learns the server's clock."""


class Received:
    """The messages of every topic, on Zenoh by key and on LCM by channel."""

    def __init__(self, endpoint: str, url: str) -> None:
        self.messages: dict[str, list[Any]] = defaultdict(list)
        self._session = open_zenoh("peer", listen=endpoint)
        self._session.declare_subscriber(
            "mocap/lab/*", lambda sample: self._add(str(sample.key_expr), sample.payload.to_bytes())
        )
        self._lcm = LcmSubscriber(open_lcm(f"{url}&recv_buf_size=4000000"), "MOCAP_LAB_.*", self._add)

    def _add(self, topic: str, data: bytes) -> None:
        name = topic.replace("MOCAP_LAB_", "lcm/").replace("mocap/lab/", "zenoh/").lower()
        if name.rpartition("/")[2] in (*COMPONENTS, "status"):
            self.messages[name].append(decode(data))

    def waits_for_measurement(self, side: str) -> bool:
        """Return whether a status has arrived that says so, so that nothing published later is missed."""
        return any(each.streams[0].state == "no measurement" for each in self.messages[f"{side}/status"])

    def close(self) -> None:
        self._lcm.close()
        self._session.close()


@contextmanager
def gateway(folder: Path, **settings: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a gateway as a process of its own."""
    file = folder / "gateway.yaml"
    file.write_text(yaml.safe_dump({"metrics": {"enabled": False}} | settings))
    with subprocess.Popen([sys.executable, "-m", "gateway", "run", "--config", str(file)]) as process:
        try:
            yield process
        finally:
            process.kill()


async def test_missing_frames_are_the_gaps_and_the_count_in_the_status(tmp_path: Path) -> None:
    endpoint, url = free_endpoint(), lcm_url()
    scene = SyntheticScene(markers=10, tools=2, analog=8, plates=1, rate_hz=200, analog_rate_hz=200)
    async with Simulator(scene) as simulator:
        simulator.stop_measurement()
        source = {
            "name": "lab",
            "host": "127.0.0.1",
            "port": simulator.port,
            "streams": [{"components": ["all"], "backlog": "latest"}],
        }
        received = Received(endpoint, url)
        zenoh = {"config": zenoh_keys("client", connect=endpoint)}
        with gateway(tmp_path, sources=[source], zenoh=zenoh, lcm={"url": url}) as process:
            try:
                await wait_until_async(lambda: received.waits_for_measurement("zenoh"))
                await wait_until_async(lambda: received.waits_for_measurement("lcm"))
                simulator.start_measurement()
                await wait_until_async(lambda: len(received.messages["zenoh/3d"]) > STEADY_FRAMES)
                process.send_signal(signal.SIGSTOP)
                await asyncio.to_thread(os.waitid, os.P_PID, process.pid, os.WSTOPPED)
                await asyncio.sleep(STOP_S)
                process.send_signal(signal.SIGCONT)
                await wait_until_async(
                    lambda: received.messages["lcm/3d"][-1].frame_number > STEADY_FRAMES + 300
                )
                simulator.stop_measurement()
                sent = simulator.components_sent
                status = received.messages["zenoh/status"]
                num_status = len(status)
                await wait_until_async(lambda: len(status) > num_status + 1)
            finally:
                received.close()

    drops = {drop.cause: drop for drop in status[-1].streams[0].drops}
    skipped = drops["skipped while behind"]
    assert skipped.messages == 4 * skipped.frames > 100
    for side in ("zenoh", "lcm"):
        for component in COMPONENTS:
            sequences = [message.sequence for message in received.messages[f"{side}/{component}"]]
            num_expected = 0 if component == "event" else skipped.frames
            assert sequences[0] == 0
            assert sequences == sorted(set(sequences))
            assert sent[component] - len(sequences) == num_expected
            assert sequences[-1] + 1 - len(sequences) == num_expected
