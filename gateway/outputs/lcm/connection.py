"""Opening LCM, and explaining failures to open and to send."""

import ipaddress
import socket
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import lcm

from gateway.errors import OutputError

DEFAULT_GROUP: Final = "239.255.76.67"
DEFAULT_PORT: Final = 7667
"""LCM's own defaults for multicast."""

MULTICAST_SCHEMES: Final = ("udpm", "mpudpm")
_RECEIVE_BUFFER_BYTES: Final = 4 * 1024 * 1024
_RMEM_MAX: Final = Path("/proc/sys/net/core/rmem_max")

BLOCKING_SCHEMES: Final = ("tcpq", "file")
"""Schemes that open and publish synchronously: a peer or disk that stalls blocks the caller."""


def scheme_of(url: str) -> str:
    """Return the scheme of an LCM URL, which selects how LCM sends: udpm, tcpq, …"""
    return urlsplit(url).scheme


def multicast_problem(url: str) -> str:
    """Return why the system cannot send to a multicast URL, and what to do; "" if it can.

    LCM itself only prints the reason to stderr and raises RuntimeError without it.
    """
    parts = urlsplit(url)
    if parts.scheme not in MULTICAST_SCHEMES:
        return ""
    try:
        group, port = str(ipaddress.IPv4Address(parts.hostname or DEFAULT_GROUP)), parts.port or DEFAULT_PORT
    except ValueError:
        return ""  # not an address: LCM itself rejects it
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((group, port))
    except OSError as error:
        return (
            f"no multicast to {url}: {error}; bring a network interface up, or give it a multicast route: "
            "ip route add 224.0.0.0/4 dev INTERFACE"
        )
    return ""


def receiving_url(url: str) -> str:
    """Return ``url`` with a receive buffer for bursts, unless it sets one or its scheme has none.

    LCM's default is the kernel's, which holds about 100 messages. LCM writes a warning on stderr if the
    kernel does not allow the size, so this asks for no more than that.
    """
    if scheme_of(url) not in MULTICAST_SCHEMES or "recv_buf_size" in url:
        return url
    try:
        largest = int(_RMEM_MAX.read_text())
    except (OSError, ValueError):
        return url  # not Linux, or a sandbox that hides it
    return f"{url}{'&' if '?' in url else '?'}recv_buf_size={min(_RECEIVE_BUFFER_BYTES, largest)}"


def open_lcm(url: str) -> lcm.LCM:
    """Return an LCM object on ``url``. Raises OutputError with the reason and the remedy.

    Blocks if the scheme is in BLOCKING_SCHEMES.
    """
    problem = multicast_problem(url)
    if problem:
        raise OutputError(problem, cause="not open")
    try:
        return lcm.LCM(url)
    except RuntimeError as error:
        raise OutputError(f"LCM does not open {url}: {error}; check lcm.url", cause="not open") from error


def send_problem(url: str, error: OSError) -> str:
    """Return why LCM did not send to ``url``, and what to do."""
    return multicast_problem(url) or f"LCM did not send to {url}: {error}; check lcm.url"
