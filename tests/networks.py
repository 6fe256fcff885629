"""Zenoh sessions, LCM addresses and routes for tests: all on this machine's loopback."""

import itertools
import json
import socket
import subprocess
from typing import Any, Final

import zenoh

_LCM_PORTS: Final = itertools.count(7720)
_MULTICAST: Final = ("224.0.0.0/4", "dev", "lo")


def free_port() -> int:
    """Return a TCP port of 127.0.0.1 that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return a Zenoh endpoint that nobody listens on."""
    return f"tcp/127.0.0.1:{free_port()}"


def zenoh_keys(mode: str, *, connect: str | None = None, listen: str | None = None) -> dict[str, Any]:
    """Return Zenoh's configuration for one session that meets others only at these endpoints."""
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


def open_zenoh(mode: str, *, connect: str | None = None, listen: str | None = None) -> zenoh.Session:
    """Return an open session, to be closed by the caller: a process that leaves one open never ends."""
    keys = zenoh_keys(mode, connect=connect, listen=listen)
    return zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))


def lcm_url() -> str:
    """Return a multicast URL that no other test of this run has: they must not hear each other."""
    return f"udpm://239.255.76.67:{next(_LCM_PORTS)}?ttl=0"


def remove_multicast_route() -> None:
    """Take away the multicast route of the network namespace (marker netns)."""
    subprocess.run(["ip", "route", "del", *_MULTICAST], check=True)


def add_multicast_route() -> None:
    """Give the network namespace its multicast route back."""
    subprocess.run(["ip", "route", "replace", *_MULTICAST], check=True)
