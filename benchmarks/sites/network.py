"""Two sites and the link between them: three network namespaces on this machine.

    site A ── to_link ⇄ to_a ── link ── to_b ⇄ to_link ── site B
    192.0.2.10         192.0.2.1       198.51.100.1       198.51.100.10

Site A is the namespace that the benchmark runs in, which tests/with-netns has made for it. The link forwards
IP packets. It can limit their rate, lose all of them, and delay them.
"""

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Self

from benchmarks.processes import PLAIN_PYTHON, Program, wait_until

A_ADDRESS: Final = "192.0.2.10"
B_ADDRESS: Final = "198.51.100.10"
_LINK_TO_A: Final = "192.0.2.1"
_LINK_TO_B: Final = "198.51.100.1"

SITE_DEVICE: Final = "to_link"
"""The interface of each site on the link."""

_QUEUE_MS: Final = 50
"""How much of a limited link's rate waits in its queue, as in a small router; what is more is dropped."""

_LISTEN: Final = "0A"
"""The state of a listening socket in /proc/net/tcp."""

_BURST_BYTES: Final = 10_000
_DELAY_DEVICE: Final = "delay"
_DELAY_TABLE: Final = "100"


class Namespace:
    """A network namespace, for as long as the process ``pid`` is in it."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def command(self, *command: str) -> list[str]:
        """Return the command that runs ``command`` in this namespace."""
        return ["nsenter", f"--net=/proc/{self.pid}/ns/net", "--", *command]

    def run(self, line: str) -> None:
        """Run a command without quotes in this namespace; raises RuntimeError with its output if it fails."""
        done = subprocess.run(  # noqa: S603 - the commands are our own
            self.command(*line.split()), capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{line}: {done.stderr.strip()}")

    def listens(self, port: int) -> bool:
        """Return whether a program of this namespace accepts connections on a port of IPv4."""
        sockets = Path(f"/proc/{self.pid}/net/tcp").read_text()
        return re.search(rf":{port:04X} 00000000:0000 {_LISTEN} ", sockets) is not None


class Network:
    """A context in which the two sites and the link exist. The link has a delay of ``delay_ms`` each way."""

    def __init__(self, delay_ms: float = 0.0) -> None:
        self._delay_ms = delay_ms

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self.a = Namespace(os.getpid())
            self.b = stack.enter_context(_new_namespace())
            self._link = stack.enter_context(_new_namespace())
            stack.callback(self.a.run, f"ip link delete {SITE_DEVICE}")
            self._connect(self.a, A_ADDRESS, "to_a", _LINK_TO_A, "198.51.100.0/24")
            self._connect(self.b, B_ADDRESS, "to_b", _LINK_TO_B, "192.0.2.0/24")
            self._link.run("sysctl --quiet --write net.ipv4.ip_forward=1")
            if self._delay_ms:
                self._add_delay(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _connect(self, site: Namespace, address: str, device: str, link_address: str, other: str) -> None:
        site.run(f"ip link add {SITE_DEVICE} type veth peer name {device} netns {self._link.pid}")
        site.run(f"ip address add {address}/24 dev {SITE_DEVICE}")
        site.run(f"ip link set {SITE_DEVICE} up")
        self._link.run(f"ip address add {link_address}/24 dev {device}")
        self._link.run(f"ip link set {device} up")
        site.run(f"ip route add {other} via {link_address}")

    def _add_delay(self, stack: contextlib.ExitStack) -> None:
        """Send what arrives from the sites through delay.py. What comes back from there goes to the sites."""
        self._link.run(f"ip tuntap add dev {_DELAY_DEVICE} mode tun")
        self._link.run(f"ip link set {_DELAY_DEVICE} up")
        self._link.run(f"ip route add default dev {_DELAY_DEVICE} table {_DELAY_TABLE}")
        for device in ("to_a", "to_b"):
            self._link.run(f"ip rule add iif {device} lookup {_DELAY_TABLE}")
        program = [sys.executable, "-m", "benchmarks.sites.delay", _DELAY_DEVICE, str(self._delay_ms)]
        stack.enter_context(Program(self._link.command(*program), environment=PLAIN_PYTHON))

    def bytes_to_b(self) -> int:
        """Return how many bytes the link has delivered to site B, with all headers."""
        for line in Path(f"/proc/{self._link.pid}/net/dev").read_text().splitlines():
            name, _, counters = line.partition(":")
            if name.strip() == "to_b":
                return int(counters.split()[8])
        raise RuntimeError("the link has no interface to site B")

    def limit(self, bits_per_s: float | None) -> None:
        """Limit the rate of the link, in each direction. None removes the limit."""
        for device in ("to_a", "to_b"):
            if bits_per_s is None:
                self._link.run(f"tc qdisc delete dev {device} root")
            else:
                queue = f"burst {_BURST_BYTES} latency {_QUEUE_MS}ms"
                self._link.run(f"tc qdisc replace dev {device} root tbf rate {bits_per_s:.0f} {queue}")

    def cut(self) -> None:
        """Lose all packets from now on. The sites are not told, as if a cable far away was cut."""
        for address in (A_ADDRESS, B_ADDRESS):
            self._link.run(f"ip route add blackhole {address}")

    def mend(self) -> None:
        """End a cut."""
        for address in (A_ADDRESS, B_ADDRESS):
            self._link.run(f"ip route delete blackhole {address}")


@contextlib.contextmanager
def _new_namespace() -> Iterator[Namespace]:
    """Return a context in which a network namespace exists. It ends with this process at the latest."""
    command = ["unshare", "--net", "cat"]  # cat ends with its input
    with subprocess.Popen(command, stdin=subprocess.PIPE) as holder:  # noqa: S603 - found through PATH
        name = Path(f"/proc/{holder.pid}/comm")
        wait_until(lambda: name.read_text() == "cat\n", "there is a network namespace")
        namespace = Namespace(holder.pid)
        namespace.run("ip link set lo up")
        yield namespace
