"""Ports, Zenoh sessions, LCM URLs and routes for tests, all on the loopback interface; a dead name server."""

import contextlib
import itertools
import json
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import zenoh

from tests.support.needs import need_programs

_LCM_PORTS: Final = itertools.count(7720, 2)
_PORTS: Final = itertools.cycle(range(10_000, 32_000))
"""By default, Linux chooses ports from 32768 on."""
_OPEN_TIMEOUT_S: Final = 120.0
_MULTICAST: Final = ("224.0.0.0/4", "dev", "lo")


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that is free, and that no other test of this run uses.

    It is not one of those that the kernel chooses for other sockets, because one of them could get it
    before the test does.
    """
    while True:
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", next(_PORTS))) as probe:
            return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return a Zenoh endpoint on a free port."""
    return f"tcp/127.0.0.1:{free_port()}"


def zenoh_keys(mode: str, *, connect: str | None = None, listen: str | None = None) -> dict[str, Any]:
    """Return a Zenoh configuration for a session that connects only through these endpoints."""
    return {
        "mode": mode,
        "connect": {
            "endpoints": [connect] if connect else [],
            "retry": {"period_init_ms": 50, "period_max_ms": 100},
        },
        "listen": {"endpoints": [listen] if listen else []},
        "scouting": {"delay": 0, "multicast": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }


def open_zenoh(
    mode: str, *, connect: str | None = None, listen: str | None = None, **sections: Any
) -> zenoh.Session:
    """Open a session with these further ``sections`` of its configuration.

    The caller must close it, because a process with an open session does not exit.
    """
    keys = {**zenoh_keys(mode, connect=connect, listen=listen), **sections}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))


def wait_for_zenoh(endpoint: str) -> zenoh.Session:
    """Open a session that is a client of a gateway, as soon as the gateway listens at ``endpoint``."""
    deadline_s = time.monotonic() + _OPEN_TIMEOUT_S
    while True:
        try:
            return open_zenoh("client", connect=endpoint)
        except zenoh.ZError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.05)


def lcm_url() -> str:
    """Return a multicast URL that no other test of this run uses, nor the next port, for requests."""
    return f"udpm://239.255.76.67:{next(_LCM_PORTS)}?ttl=0"


def _need_ip() -> None:
    need_programs("ip", "tc", packages="iproute2")


def remove_multicast_route() -> None:
    """Remove the multicast route of the network namespace (marker netns)."""
    _need_ip()
    subprocess.run(["ip", "route", "del", *_MULTICAST], check=True)


def add_multicast_route() -> None:
    """Restore the multicast route of the network namespace."""
    subprocess.run(["ip", "route", "replace", *_MULTICAST], check=True)


@contextmanager
def lan_interface(address: str) -> Iterator[int]:
    """Give the network namespace a LAN with one more computer, and multicast to it.

    ``address`` is this computer's, with /24; the other one has 254 at the end. Yields the process id of the
    other computer's network namespace, for ``nsenter``.
    """
    _need_ip()
    other = address.rpartition(".")[0] + ".254"
    with subprocess.Popen(
        ["unshare", "--net", "sh", "-c", "echo ready; exec cat"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        inside = ["nsenter", "--net", "--target", str(process.pid)]
        commands = [
            ["ip", "link", "add", "lan", "type", "veth", "peer", "lan", "netns", str(process.pid)],
            ["ip", "address", "add", f"{address}/24", "dev", "lan"],
            ["ip", "link", "set", "lan", "up"],
            ["ip", "route", "replace", "224.0.0.0/4", "dev", "lan"],
            [*inside, "ip", "address", "add", f"{other}/24", "dev", "lan"],
            [*inside, "ip", "link", "set", "lan", "up"],
            [*inside, "ip", "link", "set", "lo", "up"],
            [*inside, "ip", "route", "replace", "224.0.0.0/4", "dev", "lan"],
        ]
        try:
            for command in commands:
                subprocess.run(command, check=True)
            yield process.pid
        finally:
            subprocess.run(["ip", "link", "del", "lan"], check=False)
            add_multicast_route()
            process.kill()


@contextlib.contextmanager
def slow_interface(kbit_per_s: int) -> Iterator[str]:
    """Add a network interface that sends slowly (marker netns); yield a multicast URL that uses it."""
    _need_ip()
    group = "239.255.77.1"
    commands = (
        "ip link add slow type veth peer name slow-end",
        "ip address add 10.77.0.1/24 dev slow",
        "ip link set slow up",
        "ip link set slow-end up",
        f"ip route add {group} dev slow",
        f"tc qdisc add dev slow root tbf rate {kbit_per_s}kbit burst 10k limit 10mb",
    )
    try:
        for command in commands:
            subprocess.run(command.split(), check=True)
        yield f"udpm://{group}:7667?ttl=1"
    finally:
        subprocess.run(["ip", "link", "del", "slow"], check=True)


_ADDRESS: Final = ("127.0.0.53", 53)
_TIMEOUT_S: Final = 30
"""How long a program waits for an answer: longer than a busy computer delays what does not wait for it."""

_USE_FILE: Final = 'mount --bind "$1" /etc/resolv.conf && shift && exec "$@"'


@contextlib.contextmanager
def dead_name_server(
    folder: Path,
    options: str = f"timeout:{_TIMEOUT_S}",
    serve: Callable[[socket.socket], None] | None = None,
) -> Iterator[tuple[str, ...]]:
    """Run the server; yield what to put before a command whose names it should resolve.

    The command gets a file /etc/resolv.conf of its own, in a mount namespace. ``serve`` may answer after all,
    in a thread.
    """
    file = folder / "resolv.conf"
    file.write_text(f"nameserver {_ADDRESS[0]}\noptions {options}\n")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(_ADDRESS)
        if serve is not None:
            threading.Thread(target=serve, args=(server,), daemon=True).start()
        yield ("unshare", "--mount", "sh", "-c", _USE_FILE, "with-resolv-conf", str(file))
