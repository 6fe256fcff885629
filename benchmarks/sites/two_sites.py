"""Two sites with what runs on them: a router and a gateway each, subscribers, recorders and commands."""

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

from benchmarks import processes
from benchmarks.processes import Program, zenoh_session_config
from benchmarks.sites.network import A_ADDRESS, SITE_DEVICE, Namespace, Network
from benchmarks.sites.subscribers import ALL_KEYS, Subscribers

_PORT: Final = 7447
_LINK_PORT: Final = 7448
ENDPOINT: Final = f"tcp/127.0.0.1:{_PORT}"
"""The router, for all programs of its own site."""

_LINK_BUFFER_BYTES: Final = 65_536
"""What waits in the socket of the link is sent before anything newer: 64 kB take 0.26 s at 2 Mbit/s."""

_COMMAND_S: Final = 60.0  # catches what hangs


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    took_s: float
    output: str
    """Standard output and standard error."""


@dataclass
class Site:
    """One site. Its router can be killed and started again."""

    namespace: Namespace
    folder: Path
    router_config: dict[str, Any]
    router: Program = field(init=False)

    def start_router(self) -> None:
        """Start the router of this site, and wait until programs can connect to it."""
        file = self.folder / "router.json5"
        self.router = processes.router(file, self.router_config, self.namespace.command()).__enter__()
        processes.wait_until(lambda: self.namespace.listens(_PORT), "the router listens")

    def kill_router(self) -> None:
        """Kill the router, as a power cut does."""
        self.router.process.kill()
        self.router.process.wait()

    def subscribers(self, count: int, keys: Sequence[str] = ALL_KEYS) -> Subscribers:
        """Return native subscribers of this site."""
        return Subscribers(self.namespace, ENDPOINT, count, keys)

    def gateway(self, name: str, sources: list[dict[str, Any]]) -> Program:
        """Return a gateway that publishes through the router of this site."""
        settings = {
            "sources": sources,
            "zenoh": {"config": zenoh_session_config("client", connect=[ENDPOINT])},
            "lcm": {"enabled": False},
            "metrics": {"enabled": False},
        }
        return processes.gateway(self.folder / f"{name}.yaml", settings, self.namespace.command())

    def command(self, *arguments: str) -> list[str]:
        """Return a command of the gateway, run on this site through its router."""
        command = [sys.executable, "-m", "gateway", *arguments, "--connect", ENDPOINT]
        return self.namespace.command(*command)

    def run(self, *arguments: str) -> Ended:
        """Run a command of the gateway until it ends."""
        began_s = time.monotonic()
        done = subprocess.run(  # noqa: S603 - the command is our own
            self.command(*arguments),
            cwd=processes.ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=_COMMAND_S,
        )
        return Ended(done.returncode, time.monotonic() - began_s, done.stdout)


class TwoSites:
    """A context in which both sites have a router, and the router of site B connects to that of site A.

    ``a_settings`` are further settings of the router of site A. ``delay_ms`` is the delay of the link.
    """

    def __init__(self, *, delay_ms: float = 0.0, a_settings: dict[str, Any] | None = None) -> None:
        self._network = Network(delay_ms)
        self._a_settings = a_settings or {}

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rtc3d-sites-")))
            self.network = stack.enter_context(self._network)
            link = f"tcp/{A_ADDRESS}:{_LINK_PORT}"
            configs = {
                "a": _router_config([ENDPOINT, f"{link}#so_sndbuf={_LINK_BUFFER_BYTES}"]) | self._a_settings,
                "b": _router_config([ENDPOINT], [link]),
            }
            namespaces = {"a": self.network.a, "b": self.network.b}
            sites: dict[str, Site] = {}
            for name, config in configs.items():
                (folder / name).mkdir()
                site = sites[name] = Site(namespaces[name], folder / name, config)
                site.start_router()
                stack.callback(site.kill_router)
            self.a, self.b = sites["a"], sites["b"]
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()


_QUERIES_ON_THE_LINK: Final[dict[str, Any]] = {
    "id": "queries on the link",
    "interfaces": [SITE_DEVICE],
    "flows": ["egress"],
    "messages": ["query"],
    "key_exprs": ["**"],
    "overwrite": {"priority": "background", "congestion_control": "drop"},
}
"""Gives queries, and with them their replies, a queue of their own, and drops them if it is full.

Otherwise, they wait in the queue of the messages while the link is cut or too slow. Meanwhile, the router
delivers nothing to anybody on its site.
"""

_FRAGMENTS_WAIT_US: Final = 2000
"""How long a reply of more than one batch waits for the link before it is dropped."""


def _router_config(listen: Sequence[str], connect: Sequence[str] = ()) -> dict[str, Any]:
    """Return the configuration of a router that soon notices a dead link, and soon connects again."""
    config = processes.router_config(listen, connect)
    config["connect"]["retry"] = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}
    drop = {"max_wait_before_drop_fragments": _FRAGMENTS_WAIT_US}
    config["transport"]["link"] = {"tx": {"lease": 2000, "queue": {"congestion_control": {"drop": drop}}}}
    config["qos"] = {"network": [_QUERIES_ON_THE_LINK]}
    return config
