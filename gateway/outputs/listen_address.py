"""Addresses that servers listen on: who can connect, and how to connect from this computer."""

import ipaddress
import socket
from typing import Final

_OF_THIS_COMPUTER: Final = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104 - not bound here


def is_loopback(host: str) -> bool:
    """Return whether only programs on this computer can connect to ``host``. A name may be any address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def from_this_computer(host: str) -> str:
    """Return the address to connect to for a server that listens on ``host``, perhaps on all addresses."""
    return _OF_THIS_COMPUTER.get(host, host)


def family_of(host: str) -> socket.AddressFamily:
    """Return the family of an address; a name counts as one of IPv4."""
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def host_in_url(host: str) -> str:
    """Return ``host`` as it is written in URLs and before a port: an IPv6 address has brackets."""
    return f"[{host}]" if ":" in host else host
