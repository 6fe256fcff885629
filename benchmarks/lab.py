"""A laboratory: the simulator serves the lab workload, and a gateway receives it in two streams."""

import contextlib
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from benchmarks import processes
from benchmarks.processes import Program, Worker, zenoh_session_config
from benchmarks.subscribers import Received, Subscription, subscribe
from benchmarks.workbench import GATEWAY, lcm_url
from benchmarks.workloads import LAB, LAB_STREAMS
from tests.networks import free_port

_COMPONENTS = 5


@dataclass
class Lab:
    """A context in which a gateway publishes the lab workload to a Zenoh subscriber and an LCM subscriber."""

    reads: bool = False

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            port, url = free_port(), lcm_url(7690)
            self.endpoint = f"tcp/127.0.0.1:{free_port()}"
            stack.enter_context(Program([sys.executable, "-m", "gateway", "simulate", *_options(port)]))
            settings = {
                "sources": [processes.source(GATEWAY, port, LAB_STREAMS)],
                "zenoh": {"config": zenoh_session_config("peer", listen=[self.endpoint])},
                "lcm": {"url": url},
                "metrics": {"port": free_port()},
            }
            self.gateway = stack.enter_context(processes.gateway(folder / "gateway.yaml", settings))
            wanted = Subscription(
                zenoh_session_config("peer", connect=[self.endpoint]),
                (url,),
                zenoh=1,
                lcm=1,
                reads=self.reads,
            )
            self._subscribers = stack.enter_context(Worker(subscribe, wanted))
            processes.wait_until(
                lambda: all(len(counts) >= _COMPONENTS for counts in self._subscribers.ask("counts")),
                "both subscribers of the laboratory receive all five components",
            )
            self.take_received()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def take_received(self) -> list[Received]:
        """Return what the Zenoh subscriber and the LCM subscriber have received since the last call."""
        received: list[Received] = self._subscribers.ask("take")
        return received


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
