"""What is measured: the gateway and the bare relay at a workbench, and the gateway in a laboratory."""

import contextlib
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from benchmarks import processes
from benchmarks.processes import Program, Worker, zenoh_session_config
from benchmarks.subscribers import Received, Subscription, subscribe
from benchmarks.workloads import LAB, LAB_STREAMS, Blast, Paced, Sent, Workload, cuts, send
from gateway.messages.encode import MESSAGE_TYPES, lcm_type_name
from tests.support.networks import free_port

GATEWAY: Final = "lab"
WITHOUT_HISTORY: Final = "now"
RELAY: Final = "raw"
NATIVE: Final = "nat"
"""The names of the sources: of the gateway with and without its history, of the bare relay, and of the same
relay in C for LCM or in Rust for Zenoh. They have the same length, so that keys and channels do, too.
"""

PLAIN_TCP: Final = "tcp"
"""The name of a client that only reads the TCP connection."""

_BOTH: Final = (GATEWAY, RELAY)
_ALL: Final = (GATEWAY, WITHOUT_HISTORY, RELAY, NATIVE)
_FIRST_FRAMES: Final = 20


def lcm_url(port: int) -> str:
    """Return an LCM URL with this port.

    Every publisher needs its own port, because a subscriber receives and filters everything sent to its URL.
    The next port must be free, too: a gateway uses it for queries.
    """
    return f"udpm://239.255.76.67:{port}?ttl=0"


def relay_cuts(workload: Workload) -> list[tuple[int, int, str, str]]:
    """Return what the relay publishes of each packet: first byte, end, component and type."""
    return [
        (cut.first, cut.last, cut.component.key, lcm_type_name(MESSAGE_TYPES[cut.component]))
        for cut in cuts(workload.packet())
    ]


@dataclass
class Workbench:
    """A context in which ``clients`` serve ``subscribers`` on Zenoh, LCM, or both; the native relay, on one.

    Each tuple of ``subscribers`` is one process: its number of Zenoh subscribers and of LCM subscribers.
    If ``routed``, Zenoh sessions connect only to a router. ``reads`` and ``component`` as in Subscription.
    """

    workload: Workload
    zenoh: bool = True
    lcm: bool = True
    subscribers: Sequence[tuple[int, int]] = ()
    routed: bool = False
    reads: bool = False
    component: str = "*"
    clients: Sequence[str] = _BOTH
    programs: dict[str, Program] = field(init=False, default_factory=dict)
    subscriber_processes: list[Worker] = field(init=False, default_factory=list)

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            self.sender = stack.enter_context(Worker(send, self.workload, list(self.clients)))
            self.ports: dict[str, int] = self.sender.started
            endpoints = {name: f"tcp/127.0.0.1:{free_port()}" for name in (*_ALL, "router")}
            self.lcm_urls = {name: lcm_url(7610 + 10 * number) for number, name in enumerate(_ALL)}
            if self.routed:
                config = processes.router_config([endpoints["router"]])
                stack.enter_context(processes.router(folder / "router.json5", config))
            for name in self.clients:
                if name != PLAIN_TCP:
                    self.programs[name] = stack.enter_context(self._program(name, folder, endpoints))
            reachable = ["router"] if self.routed else self.programs
            mode = "client" if self.routed else "peer"
            config = zenoh_session_config(mode, connect=[endpoints[name] for name in reachable])
            urls = [self.lcm_urls[name] for name in self.programs]
            for zenoh, lcm in self.subscribers:
                wanted = Subscription(config, tuple(urls), zenoh, lcm, self.component, self.reads)
                self.subscriber_processes.append(stack.enter_context(Worker(subscribe, wanted)))
            self._wait_for_subscribers()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _program(self, name: str, folder: Path, endpoints: dict[str, str]) -> Program:
        if self.routed:
            config = zenoh_session_config("client", connect=[endpoints["router"]])
        else:
            config = zenoh_session_config("peer", listen=[endpoints[name]])
        if name in {GATEWAY, WITHOUT_HISTORY}:
            return processes.gateway(folder / f"{name}.yaml", self._settings(name, config))
        plan = {
            "name": name,
            "port": self.ports[name],
            "zenoh": config if self.zenoh else None,
            "lcm": self.lcm_urls[name] if self.lcm else None,
            "cuts": relay_cuts(self.workload),
        }
        return processes.native_relay(plan) if name == NATIVE else processes.relay(plan)

    def _settings(self, name: str, zenoh_config: dict[str, Any]) -> dict[str, Any]:
        return {
            "sources": [processes.source(name, self.ports[name])],
            "zenoh": {"enabled": self.zenoh, "config": zenoh_config},
            "lcm": {"enabled": self.lcm, "url": self.lcm_urls[name]},
            "metrics": {"port": free_port()},
            **({"history": {"seconds": 0}} if name == WITHOUT_HISTORY else {}),
        }

    def _wait_for_subscribers(self) -> None:
        """Send frames until every subscriber has received every topic that it should receive."""
        components = 1 if self.component != "*" else len(MESSAGE_TYPES)
        topics = components * len(self.programs)

        def all_received() -> bool:
            for name in self.programs:
                self.pace(name, _FIRST_FRAMES, 1000)
            return all(len(counts) >= topics for counts in self.received_counts())

        try:
            processes.wait_until(all_received, f"every subscriber receives {topics} topics")
        except TimeoutError as error:
            error.add_note(f"received so far: {self.received_counts()}")
            raise
        self.settle(math.inf, quiet_s=0.2)
        self.take_received()

    def blast(self, name: str, frames: int) -> tuple[Sent, float]:
        """Send at full speed; return what was sent, and the program's CPU time in s."""
        return self._measured(name, Blast(name, frames))

    def pace(self, name: str, frames: int, rate_hz: float) -> tuple[Sent, float]:
        """Send at a rate; return what was sent, and the program's CPU time in s."""
        return self._measured(name, Paced(name, frames, rate_hz))

    def _measured(self, name: str, request: Blast | Paced) -> tuple[Sent, float]:
        program = self.programs.get(name)
        before_s = 0.0 if program is None else processes.cpu_s(program.pid)
        sent: Sent = self.sender.ask(request)
        return sent, 0.0 if program is None else processes.cpu_s(program.pid) - before_s

    def received_counts(self) -> list[Counter[str]]:
        """Return how many messages of each topic each subscriber has received since ``take_received``."""
        return [counts for process in self.subscriber_processes for counts in process.ask("counts")]

    def settle(self, messages: float, quiet_s: float = 1.0) -> None:
        """Wait until each subscriber has received ``messages`` in total, or none arrive for ``quiet_s``."""
        before: list[Counter[str]] = []
        while (counts := self.received_counts()) != before and any(c.total() < messages for c in counts):
            before = counts
            time.sleep(quiet_s)

    def take_received(self) -> list[Received]:
        """Return what each subscriber has received since the last call."""
        return [received for process in self.subscriber_processes for received in process.ask("take")]


@dataclass
class Lab:
    """A context in which a gateway publishes the simulator's lab workload, which it receives in two streams.

    There is a Zenoh subscriber and an LCM subscriber.
    """

    reads: bool = False

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            port, url = free_port(), lcm_url(7690)
            self.endpoint = f"tcp/127.0.0.1:{free_port()}"
            stack.enter_context(Program(simulator_command(LAB, port)))
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
                lambda: all(len(counts) >= len(MESSAGE_TYPES) for counts in self._subscribers.ask("counts")),
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


def simulator_command(workload: Workload, port: int) -> list[str]:
    """Return the command that runs the simulator with a workload."""
    values = {
        "port": port,
        "markers": workload.markers,
        "tools": workload.tools,
        "analog": workload.analog,
        "plates": workload.plates,
        "rate": workload.rate_hz,
        "analog-rate": workload.analog_rate_hz,
        "log-level": "error",
    }
    options = (f"--{name}={value}" for name, value in values.items())
    return [sys.executable, "-m", "gateway", "simulate", *options]
