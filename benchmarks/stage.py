"""The gateway and the bare relay side by side: one sender, both measured, and their subscribers."""

import contextlib
import math
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

from benchmarks import processes
from benchmarks.processes import Program, Worker, zenoh_keys
from benchmarks.sender import Blast, Paced, Sent, send
from benchmarks.subscribers import Subscription, subscribe
from benchmarks.workloads import Workload, cuts
from gateway.messages.encode import MESSAGE_TYPES, lcm_type_name
from tests.networks import free_port

GATEWAY: Final = "lab"
RELAY: Final = "raw"
"""The names of the sources: as long as each other, so that keys and channels are."""

PLAIN: Final = "tcp"
"""A client that is neither, but reads the TCP connection itself."""

_BOTH: Final = (GATEWAY, RELAY)
_FIRST_FRAMES: Final = 20


def lcm_url(port: int) -> str:
    """Return an LCM URL; another port for each who publishes, and ten apart: gateways take the next one, too.

    Whoever listens on a URL is sent all that anybody sends there, and has the work of sorting it out.
    """
    return f"udpm://239.255.76.67:{port}?ttl=0"


@dataclass
class Stage:
    """A context in which the gateway and the relay serve ``subscribers`` on Zenoh, LCM, or both.

    Subscribers are processes of several each: (Zenoh subscribers, LCM subscribers) in each tuple.
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
    listeners: list[Worker] = field(init=False, default_factory=list)

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-bench-")))
            self.sender = stack.enter_context(Worker(send, self.workload, list(self.clients)))
            self.ports: dict[str, int] = self.sender.started
            endpoints = {name: f"tcp/127.0.0.1:{free_port()}" for name in (*_BOTH, "router")}
            self.lcm_urls = {GATEWAY: lcm_url(7670), RELAY: lcm_url(7680)}
            if self.routed:
                stack.enter_context(processes.router(endpoints["router"]))
            for name in _BOTH:
                if name in self.clients:
                    self.programs[name] = stack.enter_context(self._program(name, folder, endpoints))
            meet = ["router"] if self.routed else [name for name in _BOTH if name in self.clients]
            mode = "client" if self.routed else "peer"
            keys = zenoh_keys(mode, connect=[endpoints[name] for name in meet])
            urls = [self.lcm_urls[name] for name in self.programs]
            for zenoh, lcm in self.subscribers:
                wanted = Subscription(keys, tuple(urls), zenoh, lcm, self.component, self.reads)
                self.listeners.append(stack.enter_context(Worker(subscribe, wanted)))
            self._await_subscribers()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _program(self, name: str, folder: Path, endpoints: dict[str, str]) -> Program:
        if self.routed:
            keys = zenoh_keys("client", connect=[endpoints["router"]])
        else:
            keys = zenoh_keys("peer", listen=[endpoints[name]])
        if name == GATEWAY:
            return processes.gateway(folder / "gateway.yaml", self._settings(keys))
        return processes.relay(self._plan(keys))

    def _settings(self, keys: dict[str, Any]) -> dict[str, Any]:
        return {
            "sources": [processes.source(GATEWAY, self.ports[GATEWAY])],
            "zenoh": {"enabled": self.zenoh, "config": keys},
            "lcm": {"enabled": self.lcm, "url": self.lcm_urls[GATEWAY]},
            "metrics": {"port": free_port()},
        }

    def _plan(self, keys: dict[str, Any]) -> dict[str, Any]:
        return {
            "name": RELAY,
            "port": self.ports[RELAY],
            "zenoh": keys if self.zenoh else None,
            "lcm": self.lcm_urls[RELAY] if self.lcm else None,
            "cuts": [
                (cut.first, cut.last, cut.component.key, lcm_type_name(MESSAGE_TYPES[cut.component]))
                for cut in cuts(self.workload.packet())
            ],
        }

    def _await_subscribers(self) -> None:
        """Send frames until every subscriber has heard everyone it is to hear."""
        components = 1 if self.component != "*" else len(MESSAGE_TYPES)
        wanted = components * len(self.programs)

        def all_heard() -> bool:
            for name in self.programs:
                self.pace(name, _FIRST_FRAMES, 1000)
            return all(len(counts) >= wanted for counts in self.heard())

        try:
            processes.wait_until(all_heard, f"every subscriber hears {wanted} topics")
        except TimeoutError as error:
            error.add_note(f"so far they have had {self.heard()}")
            raise
        self.settle(math.inf, quiet_s=0.2)
        self.take()

    def blast(self, name: str, frames: int) -> tuple[Sent, float]:
        """Send as fast as it goes; return what was sent and the CPU time it cost the program, s."""
        return self._measured(name, Blast(name, frames))

    def pace(self, name: str, frames: int, rate_hz: float) -> tuple[Sent, float]:
        """Send at a rate; return what was sent and the CPU time it cost the program, s."""
        return self._measured(name, Paced(name, frames, rate_hz))

    def _measured(self, name: str, request: Blast | Paced) -> tuple[Sent, float]:
        program = self.programs.get(name)
        before_s = 0.0 if program is None else processes.cpu_s(program.pid)
        sent: Sent = self.sender.ask(request)
        return sent, 0.0 if program is None else processes.cpu_s(program.pid) - before_s

    def heard(self) -> list[Counter[str]]:
        """Return how many messages of each topic every subscriber has had since the last ``take``."""
        return [counts for listener in self.listeners for counts in listener.ask("heard")]

    def settle(self, messages: float, quiet_s: float = 1.0) -> None:
        """Return once every subscriber has had so many messages in all, or ``quiet_s`` brought none."""
        before: list[Counter[str]] = []
        while (heard := self.heard()) != before and any(each.total() < messages for each in heard):
            before = heard
            time.sleep(quiet_s)

    def take(self) -> list[Any]:
        """Return what every subscriber heard since the last time, a ``Heard`` each."""
        return [heard for listener in self.listeners for heard in listener.ask("take")]
