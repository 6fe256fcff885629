"""Opening LCM, and why it does not open, in words."""

import ipaddress
import socket
from typing import Final
from urllib.parse import urlsplit

import lcm

from gateway.errors import OutputError

MULTICAST_SCHEMES: Final = ("udpm", "mpudpm")
BLOCKING_SCHEMES: Final = ("tcpq", "file")
"""Providers that open and publish synchronously: a peer or disk that stalls blocks the caller."""


def scheme_of(url: str) -> str:
    """Return the provider of an LCM URL: udpm, tcpq, …."""
    return urlsplit(url).scheme


def multicast_problem(url: str) -> str:
    """Return why datagrams to a multicast URL would not leave this machine; "" if they would.

    LCM reports it on C's stderr only and raises a bare RuntimeError, so this checks it first.
    """
    parts = urlsplit(url)
    if parts.scheme not in MULTICAST_SCHEMES:
        return ""
    try:
        group, port = str(ipaddress.IPv4Address(parts.hostname or "239.255.76.67")), parts.port or 7667
    except ValueError:
        return ""  # not an address: LCM itself refuses it
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((group, port))
    except OSError as error:
        return (
            f"no multicast to {url}: {error}; bring a network interface up, or give it a multicast route: "
            "ip route add 224.0.0.0/4 dev INTERFACE"
        )
    return ""


def open_lcm(url: str) -> lcm.LCM:
    """Return an LCM object on ``url``; raises OutputError with the reason and the remedy.

    Blocks for BLOCKING_SCHEMES.
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
