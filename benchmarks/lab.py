"""A laboratory: the simulator plays the lab workload, and a gateway serves it on two streams."""

import contextlib
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from benchmarks import processes
from benchmarks.processes import Program, Worker, zenoh_keys
from benchmarks.stage import GATEWAY, lcm_url
from benchmarks.subscribers import Heard, Subscription, subscribe
from benchmarks.workloads import LAB, LAB_STREAMS
from tests.networks import free_port

_COMPONENTS = 5


@dataclass
class Lab:
    """A context in which the lab workload is served to one subscriber on Zenoh and one on LCM."""

    reads: bool = False

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            port, url = free_port(), lcm_url(7690)
            self.endpoint = f"tcp/127.0.0.1:{free_port()}"
            stack.enter_context(Program([sys.executable, "-m", "gateway", "simulate", *_options(port)]))
            settings = {
                "sources": [processes.source(GATEWAY, port, LAB_STREAMS)],
                "zenoh": {"config": zenoh_keys("peer", listen=[self.endpoint])},
                "lcm": {"url": url},
                "metrics": {"port": free_port()},
            }
            self.gateway = stack.enter_context(processes.gateway(folder / "gateway.yaml", settings))
            wanted = Subscription(
                zenoh_keys("peer", connect=[self.endpoint]), (url,), zenoh=1, lcm=1, reads=self.reads
            )
            self._listener = stack.enter_context(Worker(subscribe, wanted))
            processes.wait_until(
                lambda: all(len(counts) >= _COMPONENTS for counts in self._listener.ask("heard")),
                "both subscribers of the laboratory hear all five components",
            )
            self.take()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def take(self) -> list[Heard]:
        """Return what the Zenoh subscriber and the LCM subscriber heard since the last time."""
        heard: list[Heard] = self._listener.ask("take")
        return heard


def _options(port: int) -> list[str]:
    values = {
        "port": port,
        "markers": LAB.markers,
        "tools": LAB.tools,
        "analog": LAB.analog,
        "plates": LAB.plates,
        "rate": LAB.rate_hz,
        "analog-rate": LAB.analog_rate_hz,
        "log-level": "error",
    }
    return [f"--{name}={value}" for name, value in values.items()]
