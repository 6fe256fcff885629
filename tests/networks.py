"""Ports, Zenoh sessions, LCM URLs and routes for tests, all on the loopback interface."""

import itertools
import json
import socket
import subprocess
from typing import Any, Final

import zenoh

_LCM_PORTS: Final = itertools.count(7720)
_MULTICAST: Final = ("224.0.0.0/4", "dev", "lo")


def free_port() -> int:
    """Return a free TCP port of 127.0.0.1."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
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


def open_zenoh(mode: str, *, connect: str | None = None, listen: str | None = None) -> zenoh.Session:
    """Open a session. The caller must close it, because a process with an open session does not exit."""
    keys = zenoh_keys(mode, connect=connect, listen=listen)
    return zenoh.open(zenoh.Config.from_json5(json.dumps(keys)))


def lcm_url() -> str:
    """Return a multicast URL that no other test of this run uses."""
    return f"udpm://239.255.76.67:{next(_LCM_PORTS)}?ttl=0"


def remove_multicast_route() -> None:
    """Remove the multicast route of the network namespace (marker netns)."""
    subprocess.run(["ip", "route", "del", *_MULTICAST], check=True)


def add_multicast_route() -> None:
    """Restore the multicast route of the network namespace."""
    subprocess.run(["ip", "route", "replace", *_MULTICAST], check=True)
